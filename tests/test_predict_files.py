"""`cohdc predict`: its files, read back by the converters, hold the same objects."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from conversion import converted, iou, masks_of
from test_predict import Fake, make_image

from cohdc_train.errors import DataError
from cohdc_train.files import files_below
from cohdc_train.prediction.image_sources import SourceImage, read_images
from cohdc_train.prediction.options import PredictOptions
from cohdc_train.prediction.predict import predict, predict_images

FLOOR = 0.93


def photographs(folder: Path) -> list[SourceImage]:
    """Write four images, and read them as a source."""
    folder.mkdir()
    for name in "abcd":
        cv2.imwrite(str(folder / f"{name}.png"), make_image().rgb)
    return list(read_images(folder))


def written(folder: Path, images: Iterable[SourceImage], **options: Any) -> dict[str, Any]:
    return predict_images(images, Fake(), folder, PredictOptions(iou_floor=FLOOR, **options))


def holds_what_was_found(found: list[tuple[str, Any]]) -> None:
    masks = Fake()(make_image().rgb).masks()
    assert sorted(name for name, _ in found) == ["car", "person"]
    for name, mask in found:
        assert (
            iou(mask, masks[("person", "car").index(name)].astype(np.uint8)) >= FLOOR - 0.01
        )  # pycocotools fills it


def test_labelme_files_come_back_as_the_same_objects(tmp_path: Path) -> None:
    images = photographs(tmp_path / "photos")
    written(tmp_path / "out", images, format="labelme")
    assert len(list((tmp_path / "out" / "overlays").iterdir())) == 4
    splits = converted("labelme", tmp_path / "out")
    for name in "abcd":
        holds_what_was_found(masks_of(splits, name))


def test_labelme_shapes_are_what_labelme_writes_and_the_doubtful_come_first(tmp_path: Path) -> None:
    written(tmp_path / "out", photographs(tmp_path / "photos"), format="labelme", check_below=0.5)
    content = json.loads((tmp_path / "out" / "a.json").read_text())
    assert set(content) == {
        "version",
        "flags",
        "shapes",
        "imagePath",
        "imageData",
        "imageHeight",
        "imageWidth",
    }
    assert (content["imagePath"], content["imageHeight"], content["imageWidth"]) == (
        "../photos/a.png",
        100,
        120,
    )
    first, second = content["shapes"]
    assert set(first) == {
        "label",
        "points",
        "group_id",
        "shape_type",
        "mask",
        "description",
        "flags",
    }
    assert (first["label"], first["flags"], first["description"]) == (
        "car",
        {"check": True},
        "score 0.60 quality 0.30",
    )
    assert (second["label"], second["flags"]) == ("person", {"check": False})
    assert all(len(point) == 2 for point in first["points"])
    assert (tmp_path / "out" / "review.txt").read_text().splitlines() == [
        f"{name}.png: 1 of 2 contours to check, the worst of quality 0.30" for name in "abcd"
    ]


def test_a_frame_without_a_file_is_written_beside_its_labelme_file(tmp_path: Path) -> None:
    written(tmp_path, [make_image("walk_000000")], format="labelme", check_below=0.0)
    content = json.loads((tmp_path / "walk_000000.json").read_text())
    assert cv2.imread(str(tmp_path / content["imagePath"])).shape == (100, 120, 3)
    assert (tmp_path / "review.txt").read_text() == "no contour to check\n"


def test_corrected_labelme_files_are_not_written_over(tmp_path: Path) -> None:
    images = photographs(tmp_path / "photos")
    written(tmp_path / "out", images, format="labelme")
    (tmp_path / "out" / "b.json").write_text("corrected")
    with pytest.raises(DataError, match=r"a\.json: exists, perhaps corrected by hand"):
        written(tmp_path / "out", images, format="labelme")
    assert (tmp_path / "out" / "b.json").read_text() == "corrected"


def test_what_was_found_before_a_broken_image_is_kept(tmp_path: Path) -> None:
    photographs(tmp_path / "photos")
    (tmp_path / "photos" / "z.png").write_bytes(b"broken")
    with pytest.raises(DataError, match=r"z\.png: cannot be decoded"):
        written(tmp_path / "out", read_images(tmp_path / "photos"))
    assert len(json.loads((tmp_path / "out" / "predictions.json").read_text())["images"]) == 4


def test_yolo_refuses_two_images_of_one_stem(tmp_path: Path) -> None:
    photographs(tmp_path / "photos")
    cv2.imwrite(str(tmp_path / "photos" / "a.jpg"), make_image().rgb)
    with pytest.raises(DataError, match=r"a\.jpg: another image has this stem"):
        written(tmp_path / "out", read_images(tmp_path / "photos"), format="yolo")


@pytest.mark.parametrize("option", ["iou_floor", "score", "check_below", "quality"])
def test_shares_beyond_one_are_refused(tmp_path: Path, option: str) -> None:
    with pytest.raises(DataError, match=rf"{option} is 95; it must lie within 0\.\.1"):
        predict(tmp_path, model=Path("person"), out=tmp_path / "out", **{option: 95.0})


def test_yolo_labels_come_back_as_the_same_objects(tmp_path: Path) -> None:
    images = photographs(tmp_path / "photos")
    written(tmp_path / "out", images, format="yolo")
    root = tmp_path / "set"
    (root / "images").mkdir(parents=True)
    for one in images:
        cv2.imwrite(str(root / "images" / one.name), one.rgb)
    (tmp_path / "out" / "labels").rename(root / "labels")
    names = yaml.safe_load((tmp_path / "out" / "data.yaml").read_text())
    assert names == {"names": {0: "person", 1: "car"}}
    lines = (root / "labels" / "a.txt").read_text().splitlines()
    assert [line.split()[0] for line in lines] == ["0", "1"]
    assert all(0 <= float(value) <= 1 for line in lines for value in line.split()[1:])
    (root / "last.txt").write_text("images/c.png\nimages/d.png\n")
    (root / "first.txt").write_text("images/a.png\nimages/b.png\n")
    (root / "data.yaml").write_text(
        yaml.safe_dump(names | {"train": "first.txt", "val": "last.txt"})
    )
    splits = converted("yolo", root)
    for name in "abcd":
        holds_what_was_found(masks_of(splits, name))


@pytest.mark.parametrize("format", ["coco", "labelme", "yolo"])
def test_fewer_vertices_make_smaller_files(tmp_path: Path, format: Any) -> None:
    sizes = {}
    for floor in (0.9, 1.0):
        folder = tmp_path / str(floor)
        options = PredictOptions(iou_floor=floor, format=format, contour="bas_dp")
        predict_images([make_image()], Fake(), folder, options)
        files = [
            file
            for file in folder.rglob("*")
            if file.suffix in (".json", ".txt") and file.name != "review.txt"
        ]
        sizes[floor] = sum(file.stat().st_size for file in files)
    assert sizes[0.9] < sizes[1.0]


@pytest.mark.parametrize(
    ("format", "name"),
    [
        ("coco", "predictions.json"),
        ("coco", "a_overlay.jpg"),
        ("labelme", "review.txt"),
        ("yolo", "data.yaml"),
        ("yolo", "labels/a.txt"),
    ],
)
def test_prediction_keeps_files_it_did_not_write(tmp_path: Path, format: Any, name: str) -> None:
    file = tmp_path / "out" / name
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    with pytest.raises(DataError, match=r"holds .*, not written by a former cohdc predict"):
        written(tmp_path / "out", photographs(tmp_path / "photos"), format=format)
    assert files_below(tmp_path / "out") == [name]
    assert file.read_text() == "mine"


def test_second_prediction_replaces_its_files_and_keeps_labels_added_since(tmp_path: Path) -> None:
    images = photographs(tmp_path / "photos")
    for format in ("coco", "yolo"):
        out = tmp_path / format
        written(out, images[:1], format=format)
        written(out, images[:2], format=format)
    (out / "labels" / "c.txt").write_text("mine")
    with pytest.raises(DataError, match=r"c\.txt: is there already, by somebody else"):
        written(out, images, format="yolo")
    assert (out / "labels" / "c.txt").read_text() == "mine"


def test_yolo_labels_go_beside_images_that_are_there(tmp_path: Path) -> None:
    images = photographs(tmp_path / "images")
    written(tmp_path, images, format="yolo")
    assert len(files_below(tmp_path / "labels")) == 4
