"""Every foreign format becomes a folder that training reads: the same masks, nothing lost unsaid, or nothing at all."""

import base64
import json
import os
import re
import tempfile
from pathlib import Path
from typing import Any

import cv2
import foreign_toys as toys
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from cohdc_train.cli import main
from cohdc_train.data import convert as module
from cohdc_train.data.annotations import CocoObject, read_image
from cohdc_train.data.coco import CocoImage, CocoSplit, find_split, read_split
from cohdc_train.data.convert import convert
from cohdc_train.errors import DataError

BUILD = {"labelme": toys.labelme, "via": toys.via, "yolo": toys.yolo, "voc": toys.voc}
FORMATS = tuple(BUILD)


def converted(format: Any, source: Path, **options: Any) -> dict[str, CocoSplit]:
    """Both splits of the folder it is converted to, beside the source."""
    out = source.with_name(f"{source.name}_coco")
    convert(format, source, out, **options)
    return {name: read_split(name, find_split(out, name)) for name in ("train", "val")}


def image_of(splits: dict[str, CocoSplit], name: str) -> CocoImage:
    """The image of this file name, whichever split it is in."""
    (found,) = [image for split in splits.values() for image in split.images if image.path.stem == name]
    return found


def masks_of(splits: dict[str, CocoSplit], name: str) -> list[tuple[str, NDArray[np.uint8]]]:
    """(class, mask) of the objects of an image."""
    image = image_of(splits, name)
    names = splits["train"].class_names
    return [(names[o.label - 1], o.mask(image.height, image.width)) for o in image.objects]


def drawn(*polygons: list[float], size: tuple[int, int] = (toys.HEIGHT, toys.WIDTH)) -> NDArray[np.uint8]:
    """The mask of polygons."""
    return CocoObject(1, 1, (0, 0, 1, 1), 1, list(polygons), False).mask(*size)


def iou(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def file_names(split: CocoSplit) -> list[str]:
    return [row["file_name"] for row in json.loads(split.annotations.read_text())["images"]]


@pytest.mark.parametrize("format", FORMATS)
def test_masks_come_back_and_the_doctor_has_no_complaint(
    tmp_path: Path, format: str, capsys: pytest.CaptureFixture[str]
) -> None:
    splits = converted(format, BUILD[format](tmp_path / "source"))
    assert [len(splits[name].images) for name in ("train", "val")] == [3, 1]
    person = drawn(toys.PERSON) if format != "voc" else toys.box_mask(5, 4, 25, 30)
    for name in toys.NAMES:
        image = image_of(splits, name)
        objects = dict(masks_of(splits, name))
        assert np.array_equal(objects["person"], person)
        assert np.array_equal(objects["car"], toys.box_mask(*toys.CAR))
        box = {splits["train"].class_names[o.label - 1]: o.box for o in image.objects}
        assert box["car"] == (30, 20, 24, 14)
        assert image.objects[0].area == objects[splits["train"].class_names[image.objects[0].label - 1]].sum()
        original = next(p for p in (tmp_path / "source").rglob(f"{name}.?*g") if not p.parent.name.startswith("Seg"))
        assert image.path.samefile(original)
        assert read_image(image).shape == (toys.HEIGHT, toys.WIDTH, 3)
    assert sorted(path.name for path in (tmp_path / "source_coco").iterdir()) == [
        "images",
        "instances_train.json",
        "instances_val.json",
    ]
    capsys.readouterr()
    assert main(["data", "doctor", str(tmp_path / "source_coco")]) == 0
    printed = capsys.readouterr().out
    found = set(re.findall(r"\[([a-z-]+)\]: ", printed))
    assert found == ({"category-unused"} if format == "voc" else set())


def test_the_command_line_tells_counts_and_what_comes_next(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = toys.labelme(tmp_path / "source")
    line = toys.shape("person", "linestrip", [1, 1, 9, 9, 20, 4])
    toys.labelme_file(root / "a.json", [toys.shape("person", "polygon", toys.PERSON), line])
    toys.picture(root / "new.jpg", 9)
    out = tmp_path / "out"
    assert main(["data", "convert", "labelme", str(root), str(out), "--val", "0.5", "--seed", "3"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "split: drawn, --val 0.5 --seed 3",
        "train: images 2; objects 3; class car 1; class person 2",
        "val: images 2; objects 4; class car 2; class person 2",
        "left out:",
        f"       1  image without a JSON file: {root / 'new.jpg'}",
        f"       1  shape of type 'linestrip': {root / 'a.json'}: shape 2",
        f"next: cohdc data doctor {out}",
    ]


# the split


def test_the_split_is_drawn_by_image_and_always_the_same(tmp_path: Path) -> None:
    root = tmp_path / "source"
    for seed in range(10):
        toys.picture(root / f"{seed}.png", seed)
        toys.labelme_file(root / f"{seed}.json", [toys.shape("person", "polygon", toys.PERSON)])
    runs = []
    for i, (val, seed) in enumerate([(0.2, 0), (0.2, 0), (0.2, 1), (0.001, 0), (0.999, 0)]):
        out = tmp_path / str(i)
        convert("labelme", root, out, val=val, seed=seed)
        both = [file_names(read_split(name, find_split(out, name))) for name in ("train", "val")]
        assert sorted(both[0] + both[1]) == [f"{k}.png" for k in range(10)]
        runs.append(both)
    assert runs[0] == runs[1]
    assert runs[0][1] != runs[2][1]
    assert [len(val) for _, val in runs] == [2, 2, 2, 1, 9]


@pytest.mark.parametrize("format", ["labelme", "via"])
@pytest.mark.parametrize("folder", ["val", "valid"])
def test_folders_named_train_and_val_are_a_split(tmp_path: Path, format: str, folder: str) -> None:
    BUILD[format](tmp_path / "source" / "train")
    BUILD[format](tmp_path / "source" / folder)
    splits = converted(format, tmp_path / "source")
    for name, below in (("train", "train"), ("val", folder)):
        assert file_names(splits[name]) == [f"{below}/{stem}.png" for stem in toys.NAMES]
        assert all(image.path.is_file() for image in splits[name].images)


def test_same_names_in_different_folders_keep_them(tmp_path: Path) -> None:
    root = tmp_path / "source"
    toys.labelme(root / "one")
    toys.labelme(root / "two" / "deep")
    toys.labelme_file(root / ".hidden" / "a.json", "no shapes")  # type: ignore[arg-type]
    splits = converted("labelme", root)
    names = {name for split in splits.values() for name in file_names(split)}
    assert names == {f"{folder}/{stem}.png" for folder in ("one", "two/deep") for stem in toys.NAMES}
    for split in splits.values():
        for name, image in zip(file_names(split), split.images, strict=True):
            assert image.path.samefile(root / name)


def test_sub_paths_that_the_layout_would_misread_are_refused(tmp_path: Path) -> None:
    root = toys.yolo(tmp_path / "source", "train: images\nval: images/train/train\nnames: [person, car]\n")
    for split in ("train/train", "train"):
        toys.picture(root / "images" / split / "a.png", 1)
        toys.write(root / "labels" / split / "a.txt", toys.yolo_row(0, toys.PERSON))
    toys.picture(root / "images" / "train" / "train" / "train" / "a.png", 1)
    with pytest.raises(DataError, match="images/train would be taken for others of the same name"):
        convert("yolo", root, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


# all or nothing


@pytest.mark.parametrize("format", FORMATS)
def test_nothing_is_left_when_writing_fails(tmp_path: Path, format: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    source = BUILD[format](tmp_path / "source")
    before = sorted(source.rglob("*"))

    def full(*_: object) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(module, "write_text", full)
    with pytest.raises(OSError, match="No space left"):
        convert(format, source, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["source"]
    assert sorted(source.rglob("*")) == before


def test_a_full_folder_is_refused_and_an_empty_one_taken(tmp_path: Path) -> None:
    source = toys.yolo(tmp_path / "source")
    out = tmp_path / "out"
    toys.write(out / "mine.txt", "keep")
    with pytest.raises(DataError, match=r"out: holds 1 entries already; give a new or an empty folder$"):
        convert("yolo", source, out)
    assert [path.name for path in out.iterdir()] == ["mine.txt"]
    (out / "mine.txt").unlink()
    convert("yolo", source, out)
    assert (out / "instances_val.json").is_file()


def test_images_are_copied_where_links_are_impossible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def other_disk(*_: object) -> None:
        raise OSError("Invalid cross-device link")

    monkeypatch.setattr(os, "link", other_disk)
    splits = converted("yolo", toys.yolo(tmp_path / "source"))
    image = image_of(splits, "a")
    original = tmp_path / "source" / "images" / "train" / "a.png"
    assert not image.path.samefile(original)
    assert image.path.read_bytes() == original.read_bytes()


# labelme


def test_labelme_every_shape_with_an_inside(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
    assert [name for name, _ in found] == ["person", "person", "person", "bike", "person", "wheel", "person", "person"]
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


def test_labelme_image_inside_the_json_or_elsewhere(tmp_path: Path) -> None:
    root = toys.labelme(tmp_path / "source" / "json")
    png = (root / "a.png").read_bytes()
    data = toys.base64_png(np.asarray(Image.open(root / "a.png")))
    (root / "a.png").unlink()
    toys.labelme_file(root / "a.json", [toys.shape("person", "polygon", toys.PERSON)], "gone.bmp", imageData=data)
    (root / "b.png").rename(tmp_path / "source" / "b.png")
    toys.labelme_file(root / "b.json", [toys.shape("person", "polygon", toys.PERSON)], "..\\b.png", imageHeight=None)
    toys.labelme_file(root / "c.json", [toys.shape("person", "polygon", toys.PERSON)], "C:\\somebody\\c.png")
    splits = converted("labelme", tmp_path / "source")
    assert image_of(splits, "a").path.read_bytes() == png
    assert image_of(splits, "b").path.samefile(tmp_path / "source" / "b.png")
    assert image_of(splits, "c").path.samefile(root / "c.png")
    assert all(np.array_equal(masks_of(splits, name)[0][1], drawn(toys.PERSON)) for name in toys.NAMES)


def test_pictures_that_exif_turns_are_written_as_they_were_annotated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Orientation 6 shows the right column first; the file's width is the picture's height."""
    root = toys.labelme(tmp_path / "source")
    shapes = [toys.shape("person", "polygon", toys.PERSON)]
    toys.picture(root / "turned.jpg", 20, (toys.WIDTH, toys.HEIGHT), exif=6)
    toys.labelme_file(root / "turned.json", shapes, "turned.jpg")
    toys.picture(root / "plain.jpg", 21, exif=8)
    toys.labelme_file(root / "plain.json", shapes, "plain.jpg")
    data = (toys.picture(tmp_path / "inside.jpg", 22, (toys.WIDTH, toys.HEIGHT), exif=6)).read_bytes()
    toys.labelme_file(root / "inside.json", shapes, "no.jpg", imageData=embedded(data))
    splits = converted("labelme", root)
    shown = {}
    for name, file in (("turned", root / "turned.jpg"), ("inside", tmp_path / "inside.jpg")):
        stored = cv2.imread(str(file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        upright = cv2.cvtColor(cv2.rotate(stored, cv2.ROTATE_90_CLOCKWISE), cv2.COLOR_BGR2RGB)
        shown[name] = read_image(image_of(splits, name)).astype(int)
        assert np.abs(shown[name] - upright).mean() < 6  # JPEG once more
    assert image_of(splits, "plain").path.samefile(root / "plain.jpg")  # annotated on the unturned pixels
    assert "       2  image turned as its EXIF says, and written anew: " in capsys.readouterr().out
    assert main(["data", "doctor", str(tmp_path / "source_coco")]) == 0


def embedded(data: bytes) -> str:
    return base64.b64encode(data).decode()


# VIA


@pytest.mark.parametrize("version", ["project", "2", "1"])
def test_via_every_version_and_every_shape_with_an_inside(
    tmp_path: Path, version: str, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "source"
    kind = {"kind": "person"}
    toys.via(
        root,
        [
            *toys.person_and_car(),
            toys.region("circle", kind, cx=32, cy=24, r=12),
            toys.region("ellipse", kind, cx=32, cy=24, rx=20, ry=8, theta=0.6),
            toys.region("ellipse", kind, cx=32, cy=24, rx=20, ry=8),
            toys.region("polyline", kind, all_points_x=[1, 2, 3], all_points_y=[1, 5, 2]),
            toys.region("point", kind, cx=3, cy=3),
            toys.region("circle", {"kind": " "}, cx=32, cy=24, r=12),
            toys.region("circle", {}, cx=32, cy=24, r=12),
            toys.region("circle", {"kind": {"person": True, "car": False}}, cx=32, cy=24, r=12),
            toys.region("circle", {"kind": {"person": True, "car": True}}, cx=32, cy=24, r=12),
        ],
    )
    content = json.loads((root / "via.json").read_text())
    if version == "1":
        for entry in content.values():
            entry["regions"] = {str(i): row for i, row in enumerate(entry["regions"])}
            entry |= {"fileref": "", "base64_img_data": ""}
    if version == "project":
        for name in toys.NAMES:
            (root / "photos").mkdir(exist_ok=True)
            (root / f"{name}.png").rename(root / "photos" / f"{name}.png")
        settings = {"core": {"default_filepath": "photos/"}}
        content = {"_via_settings": settings, "_via_img_metadata": content, "_via_attributes": {"region": {}}}
    toys.write(root / "via.json", content)
    toys.picture(root / "new.png", 30)
    splits = converted("via", root)
    found = masks_of(splits, "a")
    assert [name for name, _ in found] == ["person", "car", "person", "person", "person", "person"]
    for (_, mask), theta in ((found[3], 0.6), (found[4], 0.0)):
        assert iou(mask, toys.disk_mask(32, 24, 20, 8, theta)) > 0.97
    for i in (2, 5):
        assert iou(found[i][1], toys.disk_mask(32, 24, 12, 12)) > 0.98
    printed = capsys.readouterr().out
    for line in (
        f"       1  image that no JSON lists: {root / 'new.png'}",
        f"       1  region of several classes: {root / 'via.json'}: a.png: region 11",
        f"       1  region of shape 'point': {root / 'via.json'}: a.png: region 7",
        f"       1  region of shape 'polyline': {root / 'via.json'}: a.png: region 6",
        f"       2  region without 'kind': {root / 'via.json'}: a.png: region 8 ...",
    ):
        assert line in printed.splitlines()


def test_via_the_class_is_in_the_attribute_one_names(tmp_path: Path) -> None:
    root = toys.via(tmp_path / "source", [toys.region("circle", {"kind": "person", "age": "7"}, cx=32, cy=24, r=12)])
    with pytest.raises(
        DataError, match=r"source: several region attributes, name the class's with --attribute: age, kind$"
    ):
        convert("via", root, tmp_path / "out")
    with pytest.raises(DataError, match=r"source: no region attribute 'name'; there is age, kind$"):
        convert("via", root, tmp_path / "out", attribute="name")
    splits = converted("via", root, attribute="kind")
    assert splits["train"].class_names == ("car", "person")


def test_via_without_attributes_takes_the_one_class_of_a_file(tmp_path: Path) -> None:
    root = tmp_path / "source"
    content = {}
    for seed in range(3):
        toys.picture(root / f"{seed}.png", seed)
        regions = {"0": toys.region("circle", {}, cx=32, cy=24, r=12)}
        content[f"{seed}"] = {"filename": f"{seed}.png", "regions": regions}
    path = toys.write(root / "via_region_data.json", content)
    with pytest.raises(
        DataError, match=r"no region attribute to take the class from; name it in a file, --names FILE$"
    ):
        convert("via", path, tmp_path / "out")
    names = toys.write(tmp_path / "names.txt", "balloon\n")
    convert("via", path, tmp_path / "out", names=names)
    assert read_split("train", find_split(tmp_path / "out", "train")).class_names == ("balloon",)
    toys.write(names, "balloon\nkite\n")
    with pytest.raises(
        DataError, match=r"names\.txt: 2 classes; --names gives all regions one, --attribute each its own$"
    ):
        convert("via", path, tmp_path / "out2", names=names)


# YOLO

YAMLS = {
    "folders": "path: .\ntrain: images/train\nval: images/val\nnames: [person, car]\n",
    "mapping": "train: [images/train]\nval: images/val\nnames:\n  1: car\n  0: person\n",
    "foreign path": "path: /datasets/mine\ntrain: images/train\nval: images/val\nnames: [person, car]\n",
    "exporter's path": "train: ../images/train\nval: ../images/val\nnc: 2\nnames: ['person', 'car']\n",
    "list files": "train: train.txt\nval: images/val\nnames: [person, car]\n",
}


@pytest.mark.parametrize("layout", YAMLS)
def test_yolo_every_way_to_say_where(tmp_path: Path, layout: str) -> None:
    root = toys.yolo(tmp_path / "source", YAMLS[layout])
    toys.write(root / "train.txt", "./images/train/a.png\n\nimages/train/b.png\n./images/train/c.png\n")
    splits = converted("yolo", root)
    assert splits["train"].class_names == ("person", "car")
    assert [file_names(splits[name]) for name in ("train", "val")] == [["a.png", "b.png", "c.png"], ["d.png"]]


def test_yolo_labels_beside_images_and_the_yaml_itself(tmp_path: Path) -> None:
    root = tmp_path / "source"
    for seed, split in enumerate(("train", "valid")):
        toys.picture(root / split / "images" / "x.png", seed)
        toys.write(root / split / "labels" / "x.txt", toys.yolo_row(0, toys.PERSON))
    path = toys.write(root / "own.yaml", "train: ../train/images\nval: ../valid/images\nnames: [person]\n")
    convert("yolo", path, tmp_path / "out")
    split = read_split("val", find_split(tmp_path / "out", "val"))
    assert file_names(split) == ["valid/images/x.png"]
    assert np.array_equal(split.images[0].objects[0].mask(toys.HEIGHT, toys.WIDTH), drawn(toys.PERSON))


def test_yolo_boxes_are_rectangles_and_said_aloud(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = toys.yolo(tmp_path / "source", YAMLS["folders"] + "test: images/test\n")
    labels = root / "labels" / "train"
    toys.write(labels / "a.txt", "1 0.65625 0.5625 0.375 0.291667\n\n0 0.5 0.5 1.2 0.5\n0 2 2 2 2 2 2\n")
    (labels / "b.txt").unlink()
    splits = converted("yolo", root)
    (car, person) = masks_of(splits, "a")
    assert np.array_equal(car[1], toys.box_mask(*toys.CAR))
    assert np.array_equal(person[1], toys.box_mask(0, 12, 64, 36))  # cut at the image
    assert image_of(splits, "b").objects == ()
    printed = capsys.readouterr().out.splitlines()
    for line in (
        "split: the source's own",
        "train: images 3; objects 4; images without objects 1; class person 2; class car 2",
        f"       2  box without a polygon, written as a rectangle: {labels / 'a.txt'}:1 ...",
        f"       1  contour without a pixel inside the image: {labels / 'a.txt'}:4",
        f"       1  test split: {root / 'data.yaml'}",
        f"       1  image without a label file: no objects: {root / 'images' / 'train' / 'b.png'}",
    ):
        assert line in printed


@settings(max_examples=40, deadline=None)
@given(
    height=st.integers(20, 300),
    width=st.integers(20, 300),
    centre=st.tuples(st.floats(0.3, 0.7), st.floats(0.3, 0.7)),
    radii=st.lists(st.floats(0.1, 0.29), min_size=3, max_size=30),
)
def test_yolo_polygons_come_back(height: int, width: int, centre: tuple[float, float], radii: list[float]) -> None:
    angles = np.arange(len(radii)) * 2 * np.pi / len(radii)
    star = np.stack([centre[0] + radii * np.cos(angles), centre[1] + radii * np.sin(angles)], axis=1).clip(0, 1)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "source"
        toys.write(root / "data.yaml", "train: images/train\nval: images/val\nnames: [star]\n")
        for split in ("train", "val"):
            toys.picture(root / "images" / split / f"{split}.png", 1, (height, width))
            toys.write(root / "labels" / split / f"{split}.txt", " ".join(["0", *(f"{v:.9f}" for v in star.ravel())]))
        (image,) = converted("yolo", root)["train"].images
    (found,) = image.objects
    exact = star * (width, height)
    np.testing.assert_allclose(np.reshape(found.segmentation, (-1, 2)), exact, atol=1e-3)
    expected = drawn(exact.ravel().tolist(), size=(height, width))
    assert iou(found.mask(height, width), expected) > 0.97


# Pascal VOC


def test_voc_the_majority_names_an_object_and_void_is_nothing(
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
    assert f"       2  object without a pixel of a class under it: {where}: object 3 ..." in capsys.readouterr().out


LABELMAP = "# label:color_rgb:parts:actions\nbackground:0,0,0::\ncar:10,20,30::\nperson:200,10,0:head,foot:run\n"


@pytest.mark.parametrize("palette", [True, False])
def test_voc_colours_of_a_labelmap(tmp_path: Path, palette: bool) -> None:
    """As CVAT writes it: no split, PNGs of colours, images of any type in sub folders."""
    root = tmp_path / "source"
    objects, classes = toys.voc_labels()
    paints = {0: (0, 0, 0), 7: (10, 20, 30), 15: (200, 10, 0), 255: (224, 224, 192), 1: (128, 0, 0), 2: (0, 128, 0)}
    for seed, name in enumerate(("day/a", "night/b", "night/c")):
        toys.picture(root / "JPEGImages" / f"{name}.png", seed)
        for folder, values in (("SegmentationObject", objects), ("SegmentationClass", classes)):
            rgb = np.zeros((*values.shape, 3), np.uint8)
            for value, colour in paints.items():
                rgb[values == value] = colour
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
    with pytest.raises(DataError, match=r"a\.png: colour 200,10,0 is no class's$"):
        convert("voc", root, tmp_path / "out")


def test_voc_names_of_a_file_number_the_classes(tmp_path: Path) -> None:
    root = toys.voc(tmp_path / "source")
    lines = ["__ignore__", "_background_", *(f"class {i}" for i in range(1, 16))]
    splits = converted("voc", root, names=toys.write(tmp_path / "names.txt", "\n".join(lines)))
    assert splits["train"].class_names == tuple(f"class {i}" for i in range(1, 16))
    assert sorted(dict(masks_of(splits, "a"))) == ["class 15", "class 7"]


# one-line errors

LABELME_ERRORS = {
    r"a\.json: line 1: not JSON": lambda p: toys.write(p, "{"),
    r"a\.json: not labelme's: no list 'shapes'$": lambda p: toys.write(p, {"images": []}),
    r"a\.json: shape 1: no label$": lambda p: toys.labelme_file(p, [toys.shape("", "polygon", toys.PERSON)]),
    r"a\.json: shape 1: circle needs its centre": lambda p: toys.labelme_file(p, [toys.shape("x", "circle", [1, 2])]),
    r"a\.json: shape 2: rectangle needs two": lambda p: toys.labelme_file(
        p, [toys.shape("x", "polygon", toys.PERSON), toys.shape("x", "rectangle", [1, 2, 3, 4, 5, 6])]
    ),
    r"a\.json: shape 1: polygon needs points": lambda p: toys.labelme_file(p, [{"label": "x", "points": [[1, "y"]]}]),
    r"a\.json: shape 1: mask needs points .* and a base64 PNG": lambda p: toys.labelme_file(
        p, [toys.shape("x", "mask", [1, 2, 9, 9], mask="aGk=")]
    ),
    r"a\.json: shape 1: mask .* that fills them$": lambda p: toys.labelme_file(
        p, [toys.shape("x", "mask", [1, 2, 9, 9], mask=toys.base64_png(np.ones((4, 4), np.uint8)))]
    ),
    r"a\.json: imagePath 'no\.png' does not exist, and there is no imageData$": lambda p: toys.labelme_file(
        p, [], "no.png"
    ),
    r"a\.json: imageData cannot be read as an image$": lambda p: toys.labelme_file(p, [], "no.png", imageData="aGk="),
    r"a\.json: imageData is 4x4, the annotation 64x48$": lambda p: toys.labelme_file(
        p, [], "no.png", imageData=toys.base64_png(np.ones((4, 4), np.uint8))
    ),
    r"a\.png: is 64x48, its annotation 60x48$": lambda p: toys.labelme_file(p, [], imageWidth=60),
    r"a\.png: cannot be read as an image$": lambda p: toys.write(p.with_suffix(".png"), "<html>"),
    r"b\.png: annotated 2 times$": lambda p: toys.labelme_file(p, [], "b.png"),
}


def refused(tmp_path: Path, format: Any, source: Path, message: str, **options: Any) -> None:
    """It is said in one line, and nothing is written."""
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DataError, match=message) as caught:
        convert(format, source, tmp_path / "out", **options)
    assert "\n" not in str(caught.value)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("message", LABELME_ERRORS)
def test_labelme_errors(tmp_path: Path, message: str) -> None:
    root = toys.labelme(tmp_path / "source")
    LABELME_ERRORS[message](root / "a.json")
    refused(tmp_path, "labelme", root, message)


VIA_ERRORS = {
    r"via\.json: not VIA's: no images$": {},
    r"via\.json: not VIA's: 'images' has no filename and regions$": {"images": [], "annotations": []},
    r"via\.json: image 'https://x\.org/a\.png' is not beside it$": {
        "a": {"filename": "https://x.org/a.png", "regions": toys.person_and_car()}
    },
    r"via\.json: a\.png: region 1: no shape_attributes$": {"a": {"filename": "a.png", "regions": [{}]}},
    r"via\.json: a\.png: region 2: circle needs cx, cy, r$": {
        "a": {"filename": "a.png", "regions": [toys.person_and_car()[0], toys.region("circle", {"kind": "x"}, cx=3)]}
    },
    r"via\.json: a\.png: region 1: polygon needs all_points_x, all_points_y$": {
        "a": {
            "filename": "a.png",
            "regions": [toys.region("polygon", {"kind": "x"}, all_points_x=[1, 2, 3], all_points_y=[1, 2])],
        }
    },
    r"via\.json: a\.png: region 1: ellipse needs cx, cy, rx, ry$": {
        "a": {"filename": "a.png", "regions": [toys.region("ellipse", {"kind": "x"}, cx=3, cy=3, rx=4, ry=0)]}
    },
}


@pytest.mark.parametrize("message", VIA_ERRORS)
def test_via_errors(tmp_path: Path, message: str) -> None:
    root = toys.via(tmp_path / "source")
    toys.write(root / "via.json", VIA_ERRORS[message])
    refused(tmp_path, "via", root, message)


YOLO_ERRORS = {
    "0 0.1 0.1 0.9 0.1 0.9": r"a\.txt:2: 5 numbers after the class; x y of three points or more, or a box of four$",
    "0 0.1": r"a\.txt:2: 1 numbers after the class",
    "2 0.1 0.1 0.9 0.1 0.9 0.9": r"a\.txt:2: class 2; names has 0 to 1$",
    "0.5 0.1 0.1 0.9 0.1 0.9 0.9": r"a\.txt:2: class 0\.5; names has 0 to 1$",
    "person 0.1 0.1 0.9 0.1 0.9 0.9": r"a\.txt:2: not a row of numbers$",
    "0 0.1 0.1 0.9 nan 0.9 0.9": r"a\.txt:2: not a row of numbers$",
    "0 5 4 25 6 22 30": r"a\.txt:2: coordinate 30; they are shares of the image's width and height$",
}
YAML_ERRORS = {
    "train: [": r"data\.yaml: line 1: not YAML$",
    "- train": r"data\.yaml: no mapping with names, train and val$",
    "train: images/train\nval: images/val\n": r"data\.yaml: names must be a list, or a mapping from 0, 1, ",
    "names: {1: a, 2: b}\n": r"data\.yaml: names must be a list",
    "names: [a, a]\n": r"data\.yaml: a name twice in names$",
    "names: [a, b]\ntrain: images/train\n": r"data\.yaml: no 'val'$",
    "names: [a, b]\ntrain: images/gone\nval: images/val\n": r"data\.yaml: train: images/gone does not exist$",
    "names: [a, b]\ntrain: list.txt\nval: images/val\n": r"list\.txt:2: images/gone\.png does not exist$",
    "names: [a, b]\ntrain: images/train\nval: labels/val\n": r"source: no object in val of 0 images$",
}


@pytest.mark.parametrize("row", YOLO_ERRORS)
def test_yolo_row_errors(tmp_path: Path, row: str) -> None:
    root = toys.yolo(tmp_path / "source")
    toys.write(root / "labels" / "train" / "a.txt", f"{toys.yolo_row(0, toys.PERSON)}\n{row}\n")
    refused(tmp_path, "yolo", root, YOLO_ERRORS[row])


@pytest.mark.parametrize("yaml", YAML_ERRORS)
def test_yolo_yaml_errors(tmp_path: Path, yaml: str) -> None:
    root = toys.yolo(tmp_path / "source", yaml)
    toys.write(root / "list.txt", "images/train/a.png\nimages/gone.png\n")
    refused(tmp_path, "yolo", root, YAML_ERRORS[yaml])


def test_yolo_needs_one_yaml(tmp_path: Path) -> None:
    root = toys.yolo(tmp_path / "source")
    (root / "data.yaml").rename(root / "one.yaml")
    toys.write(root / "two.yml", "")
    refused(tmp_path, "yolo", root, r"source: 2 YAML files where data\.yaml should be$")
    refused(tmp_path, "yolo", root / "images", r"images: no data\.yaml$")


VOC_ERRORS = {
    r"Segmentation: no train\.txt and val\.txt, and no": lambda r: (r / "ImageSets/Segmentation/val.txt").unlink(),
    r"train\.txt:2: no image 'x' in .*JPEGImages$": lambda r: toys.write(
        r / "ImageSets" / "Segmentation" / "train.txt", "a\nx\n"
    ),
    r"SegmentationObject/a\.png: does not exist$": lambda r: (r / "SegmentationObject" / "a.png").unlink(),
    r"SegmentationClass/a\.png: cannot be read as an image$": lambda r: toys.write(r / "SegmentationClass/a.png", "x"),
    r"SegmentationClass/a\.png: 4x4, .*SegmentationObject/a\.png 64x48$": lambda r: toys.palette_png(
        r / "SegmentationClass" / "a.png", np.ones((4, 4))
    ),
    r"SegmentationClass/a\.png: class 30 where there are 20$": lambda r: toys.palette_png(
        r / "SegmentationClass" / "a.png", np.full((toys.HEIGHT, toys.WIDTH), 30)
    ),
    r"SegmentationObject/a\.png: a PNG of mode I;16; a palette": lambda r: Image.fromarray(
        np.ones((toys.HEIGHT, toys.WIDTH), np.uint16)
    ).save(r / "SegmentationObject" / "a.png"),
    r"a\.jpg: is 10x10, its annotation 64x48$": lambda r: toys.picture(r / "JPEGImages" / "a.jpg", 1, (10, 10)),
    r"labelmap\.txt:2: not name:R,G,B$": lambda r: toys.write(r / "labelmap.txt", "a:1,2,3::\nb:red::\n"),
    r"labelmap\.txt:2: class 'a' is listed twice$": lambda r: toys.write(r / "labelmap.txt", "a:1,2,3::\na:4,5,6::\n"),
    r"labelmap\.txt:2: b has the colour of a$": lambda r: toys.write(r / "labelmap.txt", "a:1,2,3::\nb:1,2,3::\n"),
    r"labelmap\.txt: 0 classes; 1 to 254": lambda r: toys.write(r / "labelmap.txt", "background:0,0,0::\n"),
}


@pytest.mark.parametrize("message", VOC_ERRORS)
def test_voc_errors(tmp_path: Path, message: str) -> None:
    root = toys.voc(tmp_path / "source")
    VOC_ERRORS[message](root)
    refused(tmp_path, "voc", root, message)


JUNK = st.sampled_from([None, -1, 1e9, 10**400, float("nan"), "", "x" * 300, True, [], [[1, 2]], {}, {"a": 1}])


def places(value: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The ways to every value inside of a JSON value."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [found for key, part in pairs for found in [(*way, key), *places(part, (*way, key))]]


@settings(max_examples=60, deadline=None)
@given(format=st.sampled_from(["labelme", "via"]), data=st.data())
def test_json_damaged_anywhere_is_converted_or_named(format: Any, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as folder:
        root = BUILD[format](Path(folder) / "source")
        path = root / ("via.json" if format == "via" else "a.json")
        content = json.loads(path.read_text())
        way = data.draw(st.sampled_from(places(content)))
        target = content
        for key in way[:-1]:
            target = target[key]
        target[way[-1]] = data.draw(JUNK)
        toys.write(path, content)
        said = ""
        try:
            convert(format, root, Path(folder) / "out")
        except DataError as error:
            said = str(error)
        left = sorted(p.name for p in Path(folder).iterdir())
        assert left == ["source"] if said else ["out", "source"]
        assert not said or (str(root) in said and "\n" not in said)


def test_errors_of_any_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = toys.labelme(tmp_path / "source")
    refused(tmp_path, "labelme", tmp_path / "gone", r"gone: no such file or folder$")
    refused(tmp_path, "labelme", tmp_path, r"--attribute is for via, not for labelme$", attribute="x")
    refused(tmp_path, "yolo", tmp_path, r"--names is for voc and via, not for yolo$", names=root)
    refused(tmp_path, "labelme", root / "a.json", r"a\.json: 1 image; two or more are needed")
    refused(tmp_path, "labelme", root, r"--val 1\.0: must be between 0 and 1$", val=1.0)
    refused(tmp_path, "voc", root, r"none\.txt: no such file$", names=tmp_path / "none.txt")
    (tmp_path / "empty").mkdir()
    refused(tmp_path, "via", tmp_path / "empty", r"empty: no JSON file below it$")
    for name in toys.NAMES[:3]:
        toys.labelme_file(root / f"{name}.json", [toys.shape("x", "point", [1, 2])])
    refused(
        tmp_path,
        "labelme",
        root,
        r"source: no object in train of 3 images; 3 left out: shape of type 'point'$",
        seed=seed_drawing_d(root),
    )
    assert main(["data", "convert", "labelme", str(tmp_path / "gone"), str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err == f"cohdc data: {tmp_path / 'gone'}: no such file or folder\n"
    with pytest.raises(SystemExit) as ended:
        main(["data", "convert", "pdf", str(root), str(tmp_path / "out")])
    assert ended.value.code == 2


def seed_drawing_d(root: Path) -> int:
    """A seed for which d.png, the fourth of four, is the validation image."""
    return next(seed for seed in range(99) if np.random.default_rng(seed).permutation(4)[0] == 3)
