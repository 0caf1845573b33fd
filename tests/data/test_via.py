"""VGG Image Annotator: versions, shapes, class attributes, and named errors."""

import json
from pathlib import Path

import foreign_toys as toys
import pytest
from conversion import assert_refused, converted, iou, masks_of

from cohdc_train.data.coco import find_split, read_split
from cohdc_train.data.convert import convert
from cohdc_train.errors import DataError


@pytest.mark.parametrize("version", ["project", "2", "1"])
def test_via_reads_every_version_and_shape(
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
        content = {
            "_via_settings": settings,
            "_via_img_metadata": content,
            "_via_attributes": {"region": {}},
        }
    toys.write(root / "via.json", content)
    toys.draw_image(root / "new.png", 30)
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


def test_via_class_comes_from_named_attribute(tmp_path: Path) -> None:
    root = toys.via(
        tmp_path / "source",
        [toys.region("circle", {"kind": "person", "age": "7"}, cx=32, cy=24, r=12)],
    )
    with pytest.raises(
        DataError,
        match=r"source: several region attributes, name the class's with --attribute: age, kind$",
    ):
        convert("via", root, tmp_path / "out")
    with pytest.raises(DataError, match=r"source: no region attribute 'name'; there is age, kind$"):
        convert("via", root, tmp_path / "out", attribute="name")
    splits = converted("via", root, attribute="kind")
    assert splits["train"].class_names == ("car", "person")


def test_via_without_attributes_takes_class_of_names_file(tmp_path: Path) -> None:
    root = tmp_path / "source"
    content = {}
    for seed in range(3):
        toys.draw_image(root / f"{seed}.png", seed)
        regions = {"0": toys.region("circle", {}, cx=32, cy=24, r=12)}
        content[f"{seed}"] = {"filename": f"{seed}.png", "regions": regions}
    path = toys.write(root / "via_region_data.json", content)
    with pytest.raises(
        DataError,
        match=r"no region attribute to take the class from; name it in a file, --names FILE$",
    ):
        convert("via", path, tmp_path / "out")
    names = toys.write(tmp_path / "names.txt", "balloon\n")
    convert("via", path, tmp_path / "out", names=names)
    assert read_split("train", find_split(tmp_path / "out", "train")).class_names == ("balloon",)
    toys.write(names, "balloon\nkite\n")
    with pytest.raises(
        DataError,
        match=r"names\.txt: 2 classes; --names gives all regions one, --attribute each its own$",
    ):
        convert("via", path, tmp_path / "out2", names=names)


VIA_ERRORS = {
    r"via\.json: not VIA's: no images$": {},
    r"via\.json: not VIA's: 'images' has no filename and regions$": {
        "images": [],
        "annotations": [],
    },
    r"via\.json: image 'https://x\.org/a\.png' is not in its folder$": {
        "a": {"filename": "https://x.org/a.png", "regions": toys.person_and_car()}
    },
    r"via\.json: a\.png: region 1: no shape_attributes$": {
        "a": {"filename": "a.png", "regions": [{}]}
    },
    r"via\.json: a\.png: region 2: circle needs cx, cy, r$": {
        "a": {
            "filename": "a.png",
            "regions": [toys.person_and_car()[0], toys.region("circle", {"kind": "x"}, cx=3)],
        }
    },
    r"via\.json: a\.png: region 1: polygon needs all_points_x, all_points_y$": {
        "a": {
            "filename": "a.png",
            "regions": [
                toys.region("polygon", {"kind": "x"}, all_points_x=[1, 2, 3], all_points_y=[1, 2])
            ],
        }
    },
    r"via\.json: a\.png: region 1: ellipse needs cx, cy, rx, ry$": {
        "a": {
            "filename": "a.png",
            "regions": [toys.region("ellipse", {"kind": "x"}, cx=3, cy=3, rx=4, ry=0)],
        }
    },
}


@pytest.mark.parametrize("message", VIA_ERRORS)
def test_via_error_names_file_and_region(tmp_path: Path, message: str) -> None:
    root = toys.via(tmp_path / "source")
    toys.write(root / "via.json", VIA_ERRORS[message])
    assert_refused(tmp_path, "via", root, message)
