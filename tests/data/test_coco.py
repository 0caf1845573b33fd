"""Layouts and segmentations that the COCO loader reads, and the errors it names."""

import copy
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import coco_toys as toys
import cv2
import numpy as np
import pytest
from pycocotools import mask as rle

from cohdc_train.cli import main
from cohdc_train.data.annotations import read_image
from cohdc_train.data.coco import (
    CocoPaths,
    CocoSplit,
    SplitPaths,
    find_split,
    read_folder,
    read_split,
)
from cohdc_train.errors import DataError

PERSON, CAR = 1, 2  # labels: categories are sorted by id, 10 and 20


def split_of(tmp_path: Path, change: Any = None, classes: list[str] | None = None) -> CocoSplit:
    """Write three drawn images whose annotations a function has changed."""
    value = toys.content(tmp_path / "images", "train", 3)
    value = copy.deepcopy(value)
    if change is not None:
        change(value)
    path = toys.write(tmp_path / "some.json", value)
    return read_split("train", SplitPaths(path, tmp_path / "images"), classes)


def labels(split: CocoSplit) -> list[int]:
    return [o.label for image in split.images for o in image.objects]


LAYOUTS = {
    "flat": ("instances_{}.json", "images"),
    "coco2017": ("annotations/instances_{}2017.json", "{}2017"),
    "coco2017_below_images": ("annotations/instances_{}2017.json", "images/{}2017"),
    "plain_annotations": ("annotations/instances_{}.json", "images/{}"),
    "roboflow": ("{}/_annotations.coco.json", "{}"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("validation", ["val", "valid"])
def test_every_layout_is_found(tmp_path: Path, layout: str, validation: str) -> None:
    for name in ("train", validation):
        annotations, images = (part.format(name) for part in LAYOUTS[layout])
        toys.write(tmp_path / annotations, toys.content(tmp_path / images, name, 2))
    folder = read_folder([tmp_path])
    assert folder.class_names == ("person", "car")
    assert [len(split.images) for split in (*folder.train, folder.val)] == [2, 2]
    assert {labels_of for split in (*folder.train, folder.val) for labels_of in labels(split)} == {
        PERSON,
        CAR,
    }


def test_explicit_paths_stand_alone_and_override(tmp_path: Path) -> None:
    root = toys.folder(tmp_path / "usual")
    other = toys.write(tmp_path / "x.json", toys.content(tmp_path / "pixels", "x", 4))
    paths = CocoPaths(val_json=other, val_images=tmp_path / "pixels")
    assert len(read_folder([root], paths=paths).val.images) == 4
    alone = CocoPaths(other, tmp_path / "pixels", other, tmp_path / "pixels")
    assert len(read_folder([], paths=alone).train[0].images) == 4
    with pytest.raises(DataError, match="go together"):
        read_folder([root], paths=CocoPaths(val_json=other))
    with pytest.raises(DataError, match=r"cohdc fit DATA"):
        read_folder([])


def test_polygons_and_both_rle_give_the_same_mask(tmp_path: Path) -> None:
    polygon = [[5.0, 4.0, 25.0, 4.0, 25.0, 30.0, 5.0, 30.0], [30.0, 30.0, 40.0, 30.0, 35.0, 40.0]]
    encoded = rle.merge(rle.frPyObjects(polygon, toys.HEIGHT, toys.WIDTH))
    compressed = {"size": [toys.HEIGHT, toys.WIDTH], "counts": encoded["counts"].decode()}
    flat = split_of(tmp_path).images[0].objects[0].mask(toys.HEIGHT, toys.WIDTH) * 0

    def change(segmentation: Any) -> Any:
        return lambda v: v["annotations"][0].update(segmentation=segmentation, bbox=[5, 4, 35, 36])

    expected = (
        split_of(tmp_path, change(polygon)).images[0].objects[0].mask(toys.HEIGHT, toys.WIDTH)
    )
    runs = np.flatnonzero(np.diff(np.concatenate([[0], expected.ravel(order="F"), [0]])))
    counts = np.diff(np.concatenate([[0], runs, [flat.size]])).tolist()
    assert expected.sum() == 20 * 26 + cv2.countNonZero(expected[30:, 28:])
    for segmentation in (compressed, {"size": [toys.HEIGHT, toys.WIDTH], "counts": counts}):
        got = (
            split_of(tmp_path, change(segmentation))
            .images[0]
            .objects[0]
            .mask(toys.HEIGHT, toys.WIDTH)
        )
        assert np.array_equal(got, expected)


def test_class_filter_remaps_and_counts_classes(tmp_path: Path) -> None:
    whole = split_of(tmp_path)
    assert whole.class_names == ("person", "car")
    assert labels(whole) == [PERSON, CAR] * 3
    cars = split_of(tmp_path, classes=["car"])
    assert cars.class_names == ("car",)
    assert labels(cars) == [1, 1, 1]
    assert split_of(tmp_path, classes=["car", "person"]).class_names == ("person", "car")
    with pytest.raises(DataError, match=r"some\.json: no class 'dog'; it has person, car$"):
        split_of(tmp_path, classes=["dog"])


@pytest.mark.parametrize(
    ("given", "crowd"), [(1, True), ("1", True), (True, True), ("0", False), (None, False)]
)
def test_crowd_and_images_without_objects_are_kept(given: Any, crowd: bool, tmp_path: Path) -> None:
    def change(value: dict[str, Any]) -> None:
        value["annotations"] = [row for row in value["annotations"] if row["image_id"] == 1]
        value["annotations"][1].update(iscrowd=given)

    split = split_of(tmp_path, change)
    assert [len(image.objects) for image in split.images] == [2, 0, 0]
    assert [o.crowd for o in split.images[0].objects] == [False, crowd]
    assert [row["iscrowd"] for row in split.ground_truth()["annotations"]] == [0, int(crowd)]


def test_degenerate_objects_are_dropped_and_counted(tmp_path: Path) -> None:
    def change(value: dict[str, Any]) -> None:
        a, b, c, d, e, _ = value["annotations"]
        a["bbox"] = [5, 5, 0, 10]
        b["segmentation"] = [[1, 1, 5, 5]]
        c["segmentation"] = [[90, 5, 99, 5, 99, 9]]  # beside the image of 64 px
        d["bbox"] = [100, 5, 10, 10]
        e["segmentation"] = []

    split = split_of(tmp_path, change)
    assert split.dropped == {"degenerate box": 2, "no contour": 2, "degenerate contour": 1}
    assert labels(split) == [CAR]


def test_objects_are_clipped_to_image(tmp_path: Path) -> None:
    def change(value: dict[str, Any]) -> None:
        polygon = [-10, -10, 20, -10, 20, 30, -10, 30]
        value["annotations"][0].update(bbox=[-10, -10, 30, 40], segmentation=[polygon])

    split = split_of(tmp_path, change)
    cut = split.images[0].objects[0]
    assert cut.box == (0, 0, 20, 30)
    assert split.clipped == 1
    mask = cut.mask(toys.HEIGHT, toys.WIDTH)
    assert mask[:30, :20].all()
    assert mask.sum() == 600


def test_missing_box_comes_from_the_contour(tmp_path: Path) -> None:
    split = split_of(tmp_path, lambda v: v["annotations"][0].pop("bbox"))
    assert split.images[0].objects[0].box == (3, 4, 16, 24)


MISTAKES = {
    "image_id 99 is not in the file": lambda v: v["annotations"][0].update(image_id=99),
    "annotation 2: category_id 7": lambda v: v["annotations"][1].update(category_id=7),
    "neither polygons nor RLE": lambda v: v["annotations"][0].update(
        segmentation={"size": [48, 64]}
    ),
    "RLE of size": lambda v: v["annotations"][0].update(
        segmentation={"size": [64, 48], "counts": [64 * 48]}
    ),
    "image 2: .*gone.png does not exist": lambda v: v["images"][1].update(file_name="gone.png"),
    "needs id, file_name, height and width": lambda v: v["images"][0].pop("height"),
    "1 image ids are used twice": lambda v: v["images"][1].update(id=1),
    "same id or name": lambda v: v["categories"][0].update(name="person"),
    "no list 'categories'": lambda v: v.pop("categories"),
    "no object to learn": lambda v: v.update(annotations=[]),
}


@pytest.mark.parametrize("message", MISTAKES)
def test_mistakes_are_named_in_one_line(tmp_path: Path, message: str) -> None:
    with pytest.raises(DataError, match=rf"some\.json: .*{message}") as error:
        split_of(tmp_path, MISTAKES[message])
    assert "\n" not in str(error.value)


def test_missing_folder_file_and_broken_json_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere: no such folder$"):
        find_split(tmp_path / "nowhere", "train")
    with pytest.raises(
        DataError, match=r"no annotations of split 'train'; looked for instances_train\.json"
    ):
        find_split(tmp_path, "train")
    broken = tmp_path / "broken.json"
    broken.write_text('{"images": [],\n "annotations": [', encoding="utf-8")
    with pytest.raises(DataError, match=r"broken\.json: line 2: not JSON"):
        read_split("train", SplitPaths(broken, tmp_path))
    with pytest.raises(DataError, match=r"gone\.json: no such file$"):
        read_split("train", SplitPaths(tmp_path / "gone.json", tmp_path))


def test_train_and_val_labels_agree_by_class_name(tmp_path: Path) -> None:
    root = toys.folder(tmp_path)
    path = root / "instances_val.json"
    value = json.loads(path.read_text())
    swap = {10: 2, 20: 1}
    for row in value["annotations"]:
        row["category_id"] = swap[row["category_id"]]
    value["categories"] = [{"id": swap[c["id"]], "name": c["name"]} for c in value["categories"]]
    toys.write(path, value)
    assert labels(read_folder([root]).val) == [PERSON, CAR] * 2
    value["categories"][0]["name"] = "truck"
    toys.write(path, value)
    with pytest.raises(
        DataError, match=r"instances_val\.json: classes are truck, person; the training split's are"
    ):
        read_folder([root])
    assert read_folder([root], ["person"]).class_names == ("person",)


def test_several_roots_train_together(tmp_path: Path) -> None:
    roots = [toys.folder(tmp_path / "a", 3, 1), toys.folder(tmp_path / "b", 2, 2)]
    folder = read_folder(roots, ["person"])
    assert [len(split.images) for split in folder.train] == [3, 2]
    assert len(folder.val.images) == 1


def test_subsets_are_the_same_every_time_and_nested(tmp_path: Path) -> None:
    split = read_folder([toys.folder(tmp_path, train=8)]).train[0]
    drawn = [{image.id for image in split.subset(n).images} for n in (3, 3, 5)]
    assert drawn[0] == drawn[1] < drawn[2]
    assert split.subset(None) is split
    with pytest.raises(DataError, match="9 train images asked for, 8 there"):
        split.subset(9)


def test_images_are_rgb_and_checked(tmp_path: Path) -> None:
    image = split_of(tmp_path).images[0]
    assert tuple(read_image(image)[10, 10]) == toys.COLORS[10]
    wrong = split_of(tmp_path, lambda v: v["images"][0].update(height=64, width=48, id=1)).images[0]
    lost = r"48x64: swapped, or the file lost its EXIF orientation\?$"
    with pytest.raises(DataError, match=rf"image 1 is 64x48, its annotation {lost}"):
        read_image(wrong)


def test_stats_prints_the_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = toys.folder(tmp_path)
    assert main(["data", "stats", str(root)]) == 0
    rows = {tuple(line.split(maxsplit=1)) for line in capsys.readouterr().out.splitlines()}
    wanted = {
        "images": 6,
        "objects": 12,
        "images without objects": 0,
        "crowd": 0,
        "dropped": 0,
        "class person": 6,
    }
    for name, value in wanted.items():
        assert ("train", f"{name:<24}{value}") in rows
    assert main(["data", "stats", str(tmp_path / "images")]) == 1
    assert "looked for" in capsys.readouterr().err


def test_shared_sets_have_documented_counts() -> None:
    data = Path(__file__).parents[2] / ".." / "shared" / "data"
    if not data.is_dir():
        pytest.skip("the shared data are not here")
    folder = read_folder([data / "coco_small", data / "human_matte"], ["person"])
    assert [len(split.images) for split in (*folder.train, folder.val)] == [322, 232, 78]
    vehicles = read_folder([data / "coad_vehicles"])
    assert vehicles.class_names == ("vehicle", "person", "motorcycle")
    assert len(vehicles.val.images) == 88


def test_data_verbs_need_no_torch() -> None:
    code = "import sys, cohdc_train.data.commands; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
