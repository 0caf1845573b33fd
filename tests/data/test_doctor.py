"""Doctor on broken folders: it finds the issue, agrees with training, and fixes it."""

import json
import re
from pathlib import Path
from typing import Any

import broken_folders
import coco_toys as toys
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.image_list import ImageList
from torchvision.ops import box_iou

from cohdc_train.cli import main
from cohdc_train.data.annotations import fills_image
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.data.doctor.anchor_recall import best_overlap
from cohdc_train.data.doctor.issues import ISSUE_KINDS
from cohdc_train.data.layout import CocoPaths
from cohdc_train.errors import DataError
from cohdc_train.models import MaskRCNN, NetworkConfig

TINY = NetworkConfig(
    depth=18,
    width=0.125,
    fpn_channels=8,
    fc=16,
    canvas=(32, 48),
    anchor_scales=(8, 16, 32, 64),
    rois=16,
)

# Errors about what is learned and scored, not about what can be read.
READABLE_ERRORS = {"leak", "box-corners"}


def issues(root: Path, *options: str) -> tuple[int, dict[str, dict[str, list[str]]]]:
    """Run the doctor, and return the exit code and kind -> places of both splits."""
    code = main(["data", "doctor", str(root), "--out", str(root / "seen"), *options])
    return code, json.loads((root / "seen" / "issues.json").read_text())


# What training does with a warning of this kind is counted in the line that it logs.
COUNTED = {
    **dict.fromkeys(
        ("contour-missing", "contour-number", "contour-short", "contour-odd", "contour-empty"),
        "dropped|skipped",
    ),
    **dict.fromkeys(("box-degenerate", "box-inverted"), "degenerate box"),
    "box-outside": "clipped",
}


def train_once(paths: dict[str, Any]) -> int:
    """Take a training step on every batch, and return the number of objects in them."""
    data = CocoDataModule(canvas=(32, 48), batch_size=2, workers=0, **paths)
    data.setup("fit")
    torch.manual_seed(0)
    batches = [data.on_after_batch_transfer(batch, 0) for batch in data.train_dataloader()]
    assert all(torch.isfinite(batch.images).all() for batch in batches)
    network = MaskRCNN(data.num_classes, TINY)
    for batch in batches:
        total = sum(network.losses(batch.images, batch.targets).values())
        assert torch.isfinite(total)
        total.backward()
    gradients = [p.grad for p in network.parameters() if p.requires_grad]
    assert all(gradient is not None and torch.isfinite(gradient).all() for gradient in gradients)
    assert len(list(data.val_dataloader())) == 1
    return sum(len(target["labels"]) for batch in batches for target in batch.targets)


def test_sound_folder_has_only_note_about_id_gap(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, found = issues(broken_folders.whole(tmp_path / "a"))
    assert code == 0
    assert found == {"train": {"category-gap": ["10, 20"]}, "val": {"category-gap": ["10, 20"]}}
    printed = capsys.readouterr().out
    assert "images 6; objects 12; class person 6; class car 6" in printed
    assert "Table 3 columns it has images enough for: none" in printed
    assert (tmp_path / "a" / "seen" / "annotations.jpg").stat().st_size > 1000


def test_broken_folders_cover_most_issue_kinds() -> None:
    shown = {case.kind for case in broken_folders.BROKEN.values()}
    assert len(broken_folders.BROKEN) >= 50
    assert set(ISSUE_KINDS) - shown == {
        "category-gap",
        "category-unused",
        "class-only-val",
        "image-empty",
    }


@pytest.mark.parametrize("name", broken_folders.BROKEN)
def test_issue_is_found_agrees_with_training_and_is_fixed(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    case = broken_folders.BROKEN[name]
    root = broken_folders.build(tmp_path / "a", name)
    before = (root / "instances_train.json").read_bytes()
    code, found = issues(root, "--fix", str(tmp_path / "fixed"))
    assert case.kind in found["train"]
    errors = {kind for kind in found["train"] if ISSUE_KINDS[kind].severity == "error"}
    assert code == (1 if errors else 0)
    told = capsys.readouterr()
    assert f"[{case.kind}]" in told.out
    assert ("errors (" in told.err) == bool(errors)
    assert (root / "instances_train.json").read_bytes() == before

    if errors - READABLE_ERRORS:
        with pytest.raises(DataError) as caught:
            train_once({"root": root})
        assert len(str(caught.value).splitlines()) == 1
        assert str(root) in str(caught.value)
    else:
        if case.kind in COUNTED:
            assert re.search(
                COUNTED[case.kind], CocoDataModule(root).folder.train[0].reading_report()
            )
        assert train_once({"root": root}) > 5
    if case.fixed:
        assert_fixed_folder_trains(tmp_path / "fixed", root)


def assert_fixed_folder_trains(folder: Path, root: Path) -> None:
    """Assert that the fixed files train without a loss or an error, and lack only removed rows."""
    images = root / "images"
    files = {name: folder / f"instances_{name}.json" for name in ("train", "val")}
    paths = CocoPaths(files["train"], images, files["val"], images)
    assert train_once({"paths": paths}) > 5
    data = CocoDataModule(paths=paths)
    assert data.folder.train[0].reading_report() == ""
    removed = json.loads((folder / "removed.json").read_text())
    for name, file in files.items():
        given, kept = json.loads((root / file.name).read_text()), json.loads(file.read_text())
        for key in ("images", "annotations", "categories"):
            gone = [
                row
                for row in removed[name]
                if row["row"] not in kept[key] and row["row"] in given[key]
            ]
            assert len(kept[key]) + len(gone) == len(given[key]), (key, gone)
    linked = root.parent / "linked"
    linked.mkdir()
    (linked / "images").symlink_to(images)
    for file in files.values():
        (linked / file.name).write_bytes(file.read_bytes())
    code, found = issues(linked)
    assert code == 0
    still = {
        kind
        for split in found.values()
        for kind in split
        if ISSUE_KINDS[kind].severity == "warning"
    }
    assert still <= {"image-color", "category-unused", "class-only-val"}


def test_fix_never_overwrites_its_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = broken_folders.build(tmp_path / "a", "box elsewhere")
    before = (root / "instances_train.json").read_bytes()
    assert main(["data", "doctor", str(root), "--fix", str(root)]) == 1
    assert "would overwrite" in capsys.readouterr().err
    assert (root / "instances_train.json").read_bytes() == before


@pytest.mark.parametrize("option", ["--fix", "--out"])
@pytest.mark.parametrize("name", ["instances_val.json", "issues.json"])
def test_doctor_keeps_files_it_did_not_write(
    tmp_path: Path, option: str, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    root, out = toys.folder(tmp_path / "a"), tmp_path / "out"
    out.mkdir()
    (out / name).write_text("mine")
    is_refused = (option == "--fix") == (name == "instances_val.json")
    assert main(["data", "doctor", str(root), option, str(out)]) == is_refused
    assert (f"holds {name}, not written" in capsys.readouterr().err) == is_refused
    assert main(["data", "doctor", str(root), option, str(out)]) == is_refused, "the second time"
    assert (out / name).read_text() == "mine"


def test_class_with_objects_only_in_validation_is_found(tmp_path: Path) -> None:
    root = toys.folder(tmp_path / "a")
    content = json.loads((root / "instances_train.json").read_text())
    content["annotations"] = [row for row in content["annotations"] if row["category_id"] == 10][1:]
    toys.write(root / "instances_train.json", content)
    code, found = issues(root)
    assert code == 0
    assert found["val"]["class-only-val"] == ["car"]
    assert found["train"]["category-unused"] == ["car"]
    assert found["train"]["image-empty"] == ["train_1.png"]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 4000), min_size=1, max_size=9))
def test_run_lengths_equal_those_of_pycocotools(runs: list[int]) -> None:
    from pycocotools import mask as rle

    pixels = sum(runs)
    if pixels == 0:
        return
    encoded = rle.frPyObjects({"size": [pixels, 1], "counts": runs}, pixels, 1)["counts"]
    assert fills_image(runs, pixels)
    assert fills_image(encoded, pixels)
    assert fills_image(encoded.decode(), pixels)
    assert not fills_image(encoded.decode(), pixels + 1)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_anchor_overlap_equals_torchvision(seed: int) -> None:
    rng = np.random.default_rng(seed)
    canvas, scales = (128, 192), (16, 32, 64, 128, 100)
    corner = rng.uniform((0, 0), (150, 90), (12, 2))
    boxes = np.concatenate([corner, corner + rng.uniform(4, 60, (12, 2))], axis=1).clip(
        0, (192, 128, 192, 128)
    )
    maps = [torch.zeros(1, 1, -(-canvas[0] // s), -(-canvas[1] // s)) for s in (4, 8, 16, 32, 64)]
    generator = AnchorGenerator(tuple((s,) for s in scales), ((0.5, 1.0, 2.0),) * 5)
    (anchors,) = generator(ImageList(torch.zeros(1, 3, *canvas), [canvas]), maps)
    best = box_iou(torch.from_numpy(boxes).float(), anchors).amax(dim=1).numpy()
    np.testing.assert_allclose(best_overlap(boxes, scales, canvas), best, atol=1e-4)


def test_anchors_are_examined_on_automatic_canvas(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = broken_folders.whole(tmp_path / "a")
    height, width = CocoDataModule(root).canvas
    main(["data", "doctor", str(root)])
    assert f"on the canvas that cohdc fit chooses, {height}x{width} px" in capsys.readouterr().out

    main(["data", "doctor", str(root), "--canvas", "[64, 96]"])
    assert "on the canvas of --canvas, 64x96 px" in capsys.readouterr().out
