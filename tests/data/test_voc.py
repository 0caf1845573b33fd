"""Pascal VOC segmentation: majorities, void, colors, names, and named errors."""

from pathlib import Path

import foreign_toys as toys
import numpy as np
import pytest
from conversion import assert_refused, converted, image_of, masks_of
from PIL import Image

from cohdc_train.data.convert import convert
from cohdc_train.errors import DataError


def test_voc_class_is_majority_and_void_is_background(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = toys.voc(tmp_path / "source")
    objects, classes = toys.voc_labels()
    classes[20:30, 30:54] = 15  # 10 of the car's 14 rows are a person's
    objects[40:44, 2:6] = 3  # nothing below but background
    objects[40:44, 12:16], classes[40:44, 12:16] = 4, 255  # nothing but void
    toys.palette_png(root / "SegmentationObject" / "a.png", objects)
    toys.palette_png(root / "SegmentationClass" / "a.png", classes)
    splits = converted("voc", root)
    assert splits["train"].class_names[14] == "person"
    assert len(splits["train"].class_names) == 20
    found = masks_of(splits, "a")
    assert [name for name, _ in found] == ["person", "person"]
    assert np.array_equal(found[1][1], toys.box_mask(*toys.CAR))
    assert all(isinstance(o.segmentation["counts"], str) for o in image_of(splits, "a").objects)
    where = root / "SegmentationObject" / "a.png"
    assert (
        f"       2  object without a pixel of a class under it: {where}: object 3 ..."
        in capsys.readouterr().out
    )


LABELMAP = """\
# label:color_rgb:parts:actions
background:0,0,0::
car:10,20,30::
person:200,10,0:head,foot:run
"""


@pytest.mark.parametrize("palette", [True, False])
def test_voc_reads_colors_of_labelmap(tmp_path: Path, palette: bool) -> None:
    """CVAT writes no split, PNGs of colors, and images of any type in subfolders."""
    root = tmp_path / "source"
    objects, classes = toys.voc_labels()
    paints = {
        0: (0, 0, 0),
        7: (10, 20, 30),
        15: (200, 10, 0),
        255: (224, 224, 192),
        1: (128, 0, 0),
        2: (0, 128, 0),
    }
    for seed, name in enumerate(("day/a", "night/b", "night/c")):
        toys.draw_image(root / "JPEGImages" / f"{name}.png", seed)
        for folder, values in (("SegmentationObject", objects), ("SegmentationClass", classes)):
            rgb = np.zeros((*values.shape, 3), np.uint8)
            for value, color in paints.items():
                rgb[values == value] = color
            image = Image.fromarray(rgb)
            path = root / folder / f"{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            (image.quantize(16) if palette and folder == "SegmentationClass" else image).save(path)
    toys.write(root / "ImageSets" / "Segmentation" / "default.txt", "day/a\nnight/b\nnight/c\n")
    toys.write(root / "labelmap.txt", LABELMAP)
    splits = converted("voc", root)
    assert splits["train"].class_names == ("car", "person")
    for name in "abc":
        found = dict(masks_of(splits, name))
        assert np.array_equal(found["car"], toys.box_mask(*toys.CAR))
        assert np.array_equal(found["person"], toys.box_mask(5, 4, 25, 30))
    toys.write(root / "labelmap.txt", LABELMAP.replace("200,10,0", "200,10,1"))
    with pytest.raises(DataError, match=r"a\.png: color 200,10,0 is no class's$"):
        convert("voc", root, tmp_path / "out")


def test_voc_class_ids_follow_names_file(tmp_path: Path) -> None:
    root = toys.voc(tmp_path / "source")
    lines = ["__ignore__", "_background_", *(f"class {i}" for i in range(1, 16))]
    splits = converted("voc", root, names=toys.write(tmp_path / "names.txt", "\n".join(lines)))
    assert splits["train"].class_names == tuple(f"class {i}" for i in range(1, 16))
    assert sorted(dict(masks_of(splits, "a"))) == ["class 15", "class 7"]


VOC_ERRORS = {
    r"Segmentation: no train\.txt and val\.txt, and no": lambda r: (
        r / "ImageSets/Segmentation/val.txt"
    ).unlink(),
    r"train\.txt:2: no image 'x' in .*JPEGImages$": lambda r: toys.write(
        r / "ImageSets" / "Segmentation" / "train.txt", "a\nx\n"
    ),
    r"SegmentationObject/a\.png: does not exist$": lambda r: (
        r / "SegmentationObject" / "a.png"
    ).unlink(),
    r"SegmentationClass/a\.png: cannot be read as an image$": lambda r: toys.write(
        r / "SegmentationClass/a.png", "x"
    ),
    r"SegmentationClass/a\.png: 4x4, .*SegmentationObject/a\.png 64x48$": lambda r: (
        toys.palette_png(r / "SegmentationClass" / "a.png", np.ones((4, 4)))
    ),
    r"SegmentationClass/a\.png: class 30 where there are 20$": lambda r: toys.palette_png(
        r / "SegmentationClass" / "a.png", np.full((toys.HEIGHT, toys.WIDTH), 30)
    ),
    r"SegmentationObject/a\.png: a PNG of mode I;16; a palette": lambda r: Image.fromarray(
        np.ones((toys.HEIGHT, toys.WIDTH), np.uint16)
    ).save(r / "SegmentationObject" / "a.png"),
    r"a\.jpg: is 10x10, its annotation 64x48$": lambda r: toys.draw_image(
        r / "JPEGImages" / "a.jpg", 1, (10, 10)
    ),
    r"labelmap\.txt:2: not name:R,G,B$": lambda r: toys.write(
        r / "labelmap.txt", "a:1,2,3::\nb:red::\n"
    ),
    r"labelmap\.txt:2: class 'a' is listed twice$": lambda r: toys.write(
        r / "labelmap.txt", "a:1,2,3::\na:4,5,6::\n"
    ),
    r"labelmap\.txt:2: b has the color of a$": lambda r: toys.write(
        r / "labelmap.txt", "a:1,2,3::\nb:1,2,3::\n"
    ),
    r"labelmap\.txt: 0 classes; 1 to 254": lambda r: toys.write(
        r / "labelmap.txt", "background:0,0,0::\n"
    ),
}


@pytest.mark.parametrize("message", VOC_ERRORS)
def test_voc_error_names_file_and_line(tmp_path: Path, message: str) -> None:
    root = toys.voc(tmp_path / "source")
    VOC_ERRORS[message](root)
    assert_refused(tmp_path, "voc", root, message)
