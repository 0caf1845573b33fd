"""YOLO segmentation: image lists, boxes, exact polygons, and named errors."""

import tempfile
from pathlib import Path

import foreign_toys as toys
import numpy as np
import pytest
from conversion import assert_refused, converted, drawn, file_names, image_of, masks_of
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.data.coco import find_split, read_split
from cohdc_train.data.convert import convert

_NAMES = "names: [person, car]\n"
YAMLS = {
    "folders": "path: .\ntrain: images/train\nval: images/val\nnames: [person, car]\n",
    "mapping": "train: [images/train]\nval: images/val\nnames:\n  1: car\n  0: person\n",
    "foreign path": f"path: /datasets/mine\ntrain: images/train\nval: images/val\n{_NAMES}",
    "exporter's path": f"train: ../images/train\nval: ../images/val\nnc: 2\n{_NAMES}",
    "list files": "train: train.txt\nval: images/val\nnames: [person, car]\n",
}


@pytest.mark.parametrize("layout", YAMLS)
def test_yolo_finds_images_by_folder_list_and_several(tmp_path: Path, layout: str) -> None:
    root = toys.yolo(tmp_path / "source", YAMLS[layout])
    toys.write(
        root / "train.txt", "./images/train/a.png\n\nimages/train/b.png\n./images/train/c.png\n"
    )
    splits = converted("yolo", root)
    assert splits["train"].class_names == ("person", "car")
    assert [file_names(splits[name]) for name in ("train", "val")] == [
        ["a.png", "b.png", "c.png"],
        ["d.png"],
    ]


def test_yolo_labels_in_image_folder_and_yaml_file_as_source(tmp_path: Path) -> None:
    root = tmp_path / "source"
    for seed, split in enumerate(("train", "valid")):
        toys.draw_image(root / split / "images" / "x.png", seed)
        toys.write(root / split / "labels" / "x.txt", toys.yolo_row(0, toys.PERSON))
    path = toys.write(
        root / "own.yaml", "train: ../train/images\nval: ../valid/images\nnames: [person]\n"
    )
    convert("yolo", path, tmp_path / "out")
    split = read_split("val", find_split(tmp_path / "out", "val"))
    assert file_names(split) == ["valid/images/x.png"]
    assert np.array_equal(
        split.images[0].objects[0].mask(toys.HEIGHT, toys.WIDTH), drawn(toys.PERSON)
    )


def test_yolo_boxes_become_rectangles_and_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = toys.yolo(tmp_path / "source", YAMLS["folders"] + "test: images/test\n")
    labels = root / "labels" / "train"
    toys.write(
        labels / "a.txt", "1 0.65625 0.5625 0.375 0.291667\n\n0 0.5 0.5 1.2 0.5\n0 2 2 2 2 2 2\n"
    )
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
    center=st.tuples(st.floats(0.3, 0.7), st.floats(0.3, 0.7)),
    radii=st.lists(st.floats(0.1, 0.29), min_size=3, max_size=30),
)
def test_yolo_polygons_are_converted_exactly(
    height: int, width: int, center: tuple[float, float], radii: list[float]
) -> None:
    angles = np.arange(len(radii)) * 2 * np.pi / len(radii)
    star = np.stack(
        [center[0] + radii * np.cos(angles), center[1] + radii * np.sin(angles)], axis=1
    ).clip(0, 1)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "source"
        toys.write(root / "data.yaml", "train: images/train\nval: images/val\nnames: [star]\n")
        for split in ("train", "val"):
            toys.draw_image(root / "images" / split / f"{split}.png", 1, (height, width))
            toys.write(
                root / "labels" / split / f"{split}.txt",
                " ".join(["0", *(f"{v:.9f}" for v in star.ravel())]),
            )
        (image,) = converted("yolo", root)["train"].images
    (found,) = image.objects
    exact = star * (width, height)
    np.testing.assert_allclose(np.reshape(found.segmentation, (-1, 2)), exact, atol=1e-3)
    mask = found.mask(height, width)
    assert (mask == drawn(found.segmentation[0], size=(height, width))).all()
    # pycocotools puts corners on a grid of a fifth of a pixel: one rounded the other way moves an
    # edge by so much
    perimeter = float(np.linalg.norm(exact - np.roll(exact, -1, axis=0), axis=1).sum())
    changed = np.count_nonzero(mask != drawn(exact.ravel().tolist(), size=(height, width)))
    assert changed <= 0.2 * np.sqrt(2) * perimeter + 3


YOLO_ERRORS = {
    "0 0.1 0.1 0.9 0.1 0.9": r"a\.txt:2: 5 numbers after the class; x y of three points or more",
    "0 0.1": r"a\.txt:2: 1 numbers after the class",
    "2 0.1 0.1 0.9 0.1 0.9 0.9": r"a\.txt:2: class 2; names has 0 to 1$",
    "0.5 0.1 0.1 0.9 0.1 0.9 0.9": r"a\.txt:2: class 0\.5; names has 0 to 1$",
    "person 0.1 0.1 0.9 0.1 0.9 0.9": r"a\.txt:2: not a row of numbers$",
    "0 0.1 0.1 0.9 nan 0.9 0.9": r"a\.txt:2: not a row of numbers$",
    "0 5 4 25 6 22 30": r"a\.txt:2: coordinate 30; they are shares of the image's width",
}
YAML_ERRORS = {
    "train: [": r"data\.yaml: line 1: not YAML$",
    "- train": r"data\.yaml: no mapping with names, train and val$",
    "train: images/train\nval: images/val\n": r"data\.yaml: names must be a list, or a mapping",
    "names: {1: a, 2: b}\n": r"data\.yaml: names must be a list",
    "names: [a, a]\n": r"data\.yaml: a name twice in names$",
    "names: [a, b]\ntrain: images/train\n": r"data\.yaml: no 'val'$",
    "names: [a, b]\ntrain: images/gone\n": r"data\.yaml: train: images/gone does not exist$",
    "names: [a, b]\ntrain: list.txt\n": r"list\.txt:2: images/gone\.png does not exist$",
    "names: [a, b]\ntrain: images/train\nval: labels/val\n": r"source: no object in val of 0",
}


@pytest.mark.parametrize("row", YOLO_ERRORS)
def test_yolo_row_error_names_file_and_line(tmp_path: Path, row: str) -> None:
    root = toys.yolo(tmp_path / "source")
    toys.write(root / "labels" / "train" / "a.txt", f"{toys.yolo_row(0, toys.PERSON)}\n{row}\n")
    assert_refused(tmp_path, "yolo", root, YOLO_ERRORS[row])


@pytest.mark.parametrize("yaml", YAML_ERRORS)
def test_yolo_yaml_error_names_file(tmp_path: Path, yaml: str) -> None:
    root = toys.yolo(tmp_path / "source", yaml)
    toys.write(root / "list.txt", "images/train/a.png\nimages/gone.png\n")
    assert_refused(tmp_path, "yolo", root, YAML_ERRORS[yaml])


def test_yolo_folder_needs_exactly_one_yaml(tmp_path: Path) -> None:
    root = toys.yolo(tmp_path / "source")
    (root / "data.yaml").rename(root / "one.yaml")
    toys.write(root / "two.yml", "")
    assert_refused(tmp_path, "yolo", root, r"source: 2 YAML files where data\.yaml should be$")
    assert_refused(tmp_path, "yolo", root / "images", r"images: no data\.yaml$")
