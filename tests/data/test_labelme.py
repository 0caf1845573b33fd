"""labelme: shapes, images inside the JSON or turned by EXIF, and named errors."""

import base64
from pathlib import Path

import cv2
import foreign_toys as toys
import numpy as np
import pytest
from conversion import assert_refused, converted, drawn, image_of, iou, masks_of
from PIL import Image

from cohdc_train.cli import main
from cohdc_train.data.annotations import read_image


def test_labelme_reads_every_shape(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = toys.labelme(tmp_path / "source")
    spot = np.pad(np.ones((5, 7), np.uint8), ((1, 0), (0, 2)))
    groups = [[2.0, 2.0, 12.0, 2.0, 12.0, 9.0, 2.0, 9.0], [40.0, 30.0, 50.0, 30.0, 45.0, 40.0]]
    toys.labelme_file(
        root / "a.json",
        [
            toys.shape("person", "rectangle", [54, 34, 30, 20]),
            toys.shape("person", "circle", [32, 24, 32, 36]),
            toys.shape("person", "mask", [10, 20, 18, 25], mask=toys.base64_png(spot)),
            toys.shape("bike", "polygon", groups[0], group_id=1),
            toys.shape("person", "polygon", toys.PERSON, group_id=1),
            toys.shape("bike", "polygon", groups[1], group_id=1),
            toys.shape("wheel", "mask", [60, 44, 68, 49], mask=toys.base64_png(spot), group_id=2),
            toys.shape("wheel", "polygon", groups[0], group_id=2),
            toys.shape("person", "rectangle", [30, 20, 54, 20, 54, 34, 30, 34]),
            toys.shape("person", "mask", [-3, -2, 6, 4], mask=toys.base64_png(spot)),
            toys.shape("person", "mask", [70, 5, 78, 10], mask=toys.base64_png(spot)),
        ],
    )
    splits = converted("labelme", root)
    assert splits["train"].class_names == ("bike", "car", "person", "wheel")
    found = masks_of(splits, "a")
    assert [name for name, _ in found] == [
        "person",
        "person",
        "person",
        "bike",
        "person",
        "wheel",
        "person",
        "person",
    ]
    masks = [mask for _, mask in found]
    assert np.array_equal(masks[0], toys.box_mask(*toys.CAR))
    assert iou(masks[1], toys.disk_mask(32, 24, 12, 12)) > 0.98
    expected = np.zeros_like(masks[2])
    expected[20:26, 10:19] = spot
    assert np.array_equal(masks[2], expected)
    assert np.array_equal(masks[3], drawn(*groups))
    assert np.array_equal(masks[4], drawn(toys.PERSON))
    cut = drawn(groups[0])
    cut[45:48, 60:64] = 1  # the mask's first row is empty, and its last lies below the image
    assert np.array_equal(masks[5], cut)
    assert np.array_equal(masks[6], masks[0])
    assert np.array_equal(masks[7], toys.box_mask(0, 0, 4, 4))
    kinds = [type(o.segmentation) for o in image_of(splits, "a").objects]
    assert kinds == [list, list, dict, list, list, dict, list, dict]
    assert len(image_of(splits, "a").objects[3].segmentation) == 2
    outside = f"       1  contour without a pixel inside the image: {root / 'a.json'}: shape 11"
    assert outside in capsys.readouterr().out.splitlines()


def test_labelme_image_is_found_inside_json_or_in_other_folder(tmp_path: Path) -> None:
    root = toys.labelme(tmp_path / "source" / "json")
    png = (root / "a.png").read_bytes()
    data = toys.base64_png(np.asarray(Image.open(root / "a.png")))
    (root / "a.png").unlink()
    toys.labelme_file(
        root / "a.json", [toys.shape("person", "polygon", toys.PERSON)], "gone.bmp", imageData=data
    )
    (root / "b.png").rename(tmp_path / "source" / "b.png")
    toys.labelme_file(
        root / "b.json",
        [toys.shape("person", "polygon", toys.PERSON)],
        "..\\b.png",
        imageHeight=None,
    )
    toys.labelme_file(
        root / "c.json", [toys.shape("person", "polygon", toys.PERSON)], "C:\\somebody\\c.png"
    )
    splits = converted("labelme", tmp_path / "source")
    assert image_of(splits, "a").path.read_bytes() == png
    assert image_of(splits, "b").path.samefile(tmp_path / "source" / "b.png")
    assert image_of(splits, "c").path.samefile(root / "c.png")
    assert all(
        np.array_equal(masks_of(splits, name)[0][1], drawn(toys.PERSON)) for name in toys.NAMES
    )


def test_images_turned_by_exif_are_written_as_annotated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Orientation 6 shows the right column first; the file's width is the image's height."""
    root = toys.labelme(tmp_path / "source")
    shapes = [toys.shape("person", "polygon", toys.PERSON)]
    toys.draw_image(root / "turned.jpg", 20, (toys.WIDTH, toys.HEIGHT), exif=6)
    toys.labelme_file(root / "turned.json", shapes, "turned.jpg")
    toys.draw_image(root / "plain.jpg", 21, exif=8)
    toys.labelme_file(root / "plain.json", shapes, "plain.jpg")
    data = (
        toys.draw_image(tmp_path / "inside.jpg", 22, (toys.WIDTH, toys.HEIGHT), exif=6)
    ).read_bytes()
    toys.labelme_file(root / "inside.json", shapes, "no.jpg", imageData=embedded(data))
    splits = converted("labelme", root)
    shown = {}
    for name, file in (("turned", root / "turned.jpg"), ("inside", tmp_path / "inside.jpg")):
        stored = cv2.imread(str(file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        upright = cv2.cvtColor(cv2.rotate(stored, cv2.ROTATE_90_CLOCKWISE), cv2.COLOR_BGR2RGB)
        shown[name] = read_image(image_of(splits, name)).astype(int)
        assert np.abs(shown[name] - upright).mean() < 6  # JPEG once more
    assert image_of(splits, "plain").path.samefile(
        root / "plain.jpg"
    )  # annotated on the unturned pixels
    assert "       2  image turned as its EXIF says, and written again: " in capsys.readouterr().out
    assert main(["data", "doctor", str(tmp_path / "source_coco")]) == 0


def embedded(data: bytes) -> str:
    return base64.b64encode(data).decode()


LABELME_ERRORS = {
    r"a\.json: line 1: not JSON": lambda p: toys.write(p, "{"),
    r"a\.json: not labelme's: no list 'shapes'$": lambda p: toys.write(p, {"images": []}),
    r"a\.json: shape 1: no label$": lambda p: toys.labelme_file(
        p, [toys.shape("", "polygon", toys.PERSON)]
    ),
    r"a\.json: shape 1: circle needs its center": lambda p: toys.labelme_file(
        p, [toys.shape("x", "circle", [1, 2])]
    ),
    r"a\.json: shape 2: rectangle needs two": lambda p: toys.labelme_file(
        p,
        [toys.shape("x", "polygon", toys.PERSON), toys.shape("x", "rectangle", [1, 2, 3, 4, 5, 6])],
    ),
    r"a\.json: shape 1: polygon needs points": lambda p: toys.labelme_file(
        p, [{"label": "x", "points": [[1, "y"]]}]
    ),
    r"a\.json: shape 1: mask needs points .* and a base64 PNG": lambda p: toys.labelme_file(
        p, [toys.shape("x", "mask", [1, 2, 9, 9], mask="aGk=")]
    ),
    r"a\.json: shape 1: mask .* that fills them$": lambda p: toys.labelme_file(
        p, [toys.shape("x", "mask", [1, 2, 9, 9], mask=toys.base64_png(np.ones((4, 4), np.uint8)))]
    ),
    r"a\.json: imagePath 'no\.png' does not exist, and there is no imageData$": lambda p: (
        toys.labelme_file(p, [], "no.png")
    ),
    r"a\.json: imageData cannot be read as an image$": lambda p: toys.labelme_file(
        p, [], "no.png", imageData="aGk="
    ),
    r"a\.json: imageData is 4x4, the annotation 64x48$": lambda p: toys.labelme_file(
        p, [], "no.png", imageData=toys.base64_png(np.ones((4, 4), np.uint8))
    ),
    r"a\.png: is 64x48, its annotation 60x48$": lambda p: toys.labelme_file(p, [], imageWidth=60),
    r"a\.png: cannot be read as an image$": lambda p: toys.write(p.with_suffix(".png"), "<html>"),
    r"b\.png: annotated 2 times$": lambda p: toys.labelme_file(p, [], "b.png"),
}


@pytest.mark.parametrize("message", LABELME_ERRORS)
def test_labelme_error_names_file_and_shape(tmp_path: Path, message: str) -> None:
    root = toys.labelme(tmp_path / "source")
    LABELME_ERRORS[message](root / "a.json")
    assert_refused(tmp_path, "labelme", root, message)
