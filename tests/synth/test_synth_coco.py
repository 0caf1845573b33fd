"""COCO-format sets: readable by pycocotools, exact, repeatable, with disjoint splits."""

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from cohdc_train.errors import DataError
from cohdc_train.synth import coco
from cohdc_train.synth.coco import SMALLEST_SHARE, LabeledImage, draw_populated_room, render_image
from cohdc_train.synth.coco_annotation import annotate
from cohdc_train.synth.random_streams import stream

pytest.importorskip("embreex")
pycocotools = pytest.importorskip("pycocotools.coco")
# pycocotools' arrays lack numpy 2's copy keyword
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")

SIZE = (96, 128)


def digest(folder: Path) -> dict[str, str]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synth") / "set"
    coco(out, train=10, val=3, size=SIZE, seed=5)
    return out


def test_layout_and_loading(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert {p.name for p in folder.iterdir()} == {
        "images",
        "instances_train.json",
        "instances_val.json",
    }
    assert len(list((folder / "images").iterdir())) == 13
    people = 0
    for split, number in (("train", 10), ("val", 3)):
        api = pycocotools.COCO(folder / f"instances_{split}.json")
        assert [c["name"] for c in api.loadCats(api.getCatIds())] == ["person"]
        assert len(api.imgs) == number
        for image in api.loadImgs(api.getImgIds()):
            pixels = cv2.imread(str(folder / "images" / image["file_name"]))
            assert pixels.shape == (image["height"], image["width"], 3) == (*SIZE, 3)
            assert pixels.std() > 10
            masks = [api.annToMask(a) for a in api.loadAnns(api.getAnnIds(image["id"]))]
            if masks:
                assert np.sum(masks, axis=0).max() == 1, "no pixel has two owners"
        for annotation in api.loadAnns(api.getAnnIds()):
            mask = api.annToMask(annotation)
            assert mask.sum() == annotation["area"] > 0
            assert annotation["iscrowd"] == (mask.mean() < SMALLEST_SHARE)
        people += len(api.anns)
    assert people >= 10


def test_small_parts_of_people_are_annotated_as_crowd() -> None:
    mask = np.zeros((40, 50), dtype=np.bool_)
    mask[3:5, 4:8] = True
    crumb = annotate(mask, 1, 1, crowd=True)
    assert crumb["iscrowd"] == 1
    assert crumb["area"] == 8
    assert set(crumb["segmentation"]) == {"size", "counts"}, "COCO keeps crowds as run lengths"
    assert isinstance(annotate(mask, 1, 2)["segmentation"], list)


def test_annotations_are_the_rendered_masks(folder: Path) -> None:
    rng = stream(5, "coco-train", 0)
    from cohdc_train.synth.room_layouts import texture_detail

    room_with_people = draw_populated_room(rng, texture_detail(SIZE))
    api = pycocotools.COCO(folder / "instances_train.json")
    seen = 0
    for image_id in (1, 2, 3, 4, 5):
        rendered: LabeledImage = render_image(room_with_people, rng, SIZE)
        annotations = api.loadAnns(sorted(api.getAnnIds(image_id)))
        assert len(annotations) == len(rendered.masks)
        for annotation, mask in zip(annotations, rendered.masks, strict=True):
            np.testing.assert_array_equal(api.annToMask(annotation).astype(bool), mask)
            seen += 1
    assert seen > 0


def test_same_seed_same_bytes_and_another_seed_differs(tmp_path: Path) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        coco(tmp_path / name, train=2, val=1, size=(48, 64), seed=seed)
    assert digest(tmp_path / "a") == digest(tmp_path / "b")
    first, other = digest(tmp_path / "a"), digest(tmp_path / "c")
    assert all(first[name] != other[name] for name in first)


def test_near_people_cover_more_of_the_image(folder: Path, tmp_path: Path) -> None:
    """The same rooms and people, at .45 to 1.3 m instead of .7 to 3.7 m."""
    coco(tmp_path / "near", train=10, val=1, size=SIZE, seed=5, distance=(0.45, 1.3))
    shares = []
    for root in (folder, tmp_path / "near"):
        annotations = json.loads((root / "instances_train.json").read_text())["annotations"]
        shares.append(
            sum(annotation["area"] for annotation in annotations) / (10 * SIZE[0] * SIZE[1])
        )
    assert shares[1] > 1.5 * shares[0], shares


def test_rooms_of_the_splits_and_of_the_sequence_differ() -> None:
    keys = [("coco-train", 0), ("coco-train", 1), ("coco-val", 0), ("coco-val", 1), ("sequence", 0)]
    stages = [draw_populated_room(stream(0, *key), 128) for key in keys]
    for i, a in enumerate(stages):
        for b in stages[:i]:
            assert a.room.size != b.room.size
            walls = [
                np.array_equal(x, y)
                for x, y in zip(a.room.textures[:6], b.room.textures[:6], strict=True)
            ]
            assert not any(walls)
            for p in a.people:
                for q in b.people:
                    assert p.height != q.height
                    assert not np.array_equal(p.textures[0], q.textures[0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"train": 0}, "train: 0 images"),
        ({"val": -1}, "val: -1 images"),
        ({"size": (20, 256)}, "size: 20 x 256 px"),
        ({"seed": -3}, "seed: -3"),
        ({"distance": (0.2, 3.0)}, "distance: 0.2 to 3.0 m"),
        ({"distance": (2.0, 1.0)}, "distance: 2.0 to 1.0 m"),
        ({"distance": (0.5, float("inf"))}, "distance: 0.5 to inf m"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line(
    tmp_path: Path, arguments: dict[str, object], message: str
) -> None:
    with pytest.raises(DataError, match=message) as caught:
        coco(tmp_path / "set", **arguments)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_images_without_people_are_listed(folder: Path) -> None:
    document = json.loads((folder / "instances_train.json").read_text())
    assert [image["id"] for image in document["images"]] == list(range(1, 11))
    assert len({image["file_name"] for image in document["images"]}) == 10
