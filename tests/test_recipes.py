"""The recipes of docs/recipes: each is applied to a copy of the package, and what it adds runs."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import coco_toys
import cv2
import numpy as np
import onnx
import pytest
from doc_blocks import DOCS, ROOT, Block, blocks
from onnx import TensorProto, helper, numpy_helper
from plane_world import CAMERA_YAML, camera_path, render, room

RECIPES = sorted((DOCS / "recipes").glob("*.md"))
MOST_LINES = 50


def changes(name: str) -> list[Block]:
    """Return the blocks of a recipe that are files or changes of files."""
    found = blocks(DOCS / "recipes" / f"{name}.md")
    return [block for block in found if block.marker.startswith(("file: ", "diff: "))]


def apply_diff(file: Path, diff: str) -> None:
    """Replace each group of `-` lines by the `+` lines that follow it."""
    text = file.read_text(encoding="utf-8")
    old: list[str] = []
    new: list[str] = []
    for line in [*diff.splitlines(), "-"]:
        if line.startswith("-") and new:
            before, after = "\n".join(old), "\n".join(new)
            assert text.count(f"{before}\n") == 1, f"{file.name} has no single line {before!r}"
            text = text.replace(f"{before}\n", f"{after}\n")
            old, new = [], []
        (new if line.startswith("+") else old).append(line[1:])
    file.write_text(text, encoding="utf-8")


class Checkout:
    """A copy of the package in a folder, with a recipe applied."""

    def __init__(self, folder: Path, recipe: str) -> None:
        self.folder = folder
        ignored = shutil.ignore_patterns("__pycache__", "*.onnx")
        shutil.copytree(ROOT / "cohdc_train", folder / "cohdc_train", ignore=ignored)
        for model in (ROOT / "cohdc_train" / "shipped").glob("*.onnx"):
            (folder / "cohdc_train" / "shipped" / model.name).symlink_to(model)
        shutil.copytree(ROOT / "configs", folder / "configs")
        for block in changes(recipe):
            kind, name = block.marker.split(": ")
            if kind == "file":
                (folder / name).write_text(block.text, encoding="utf-8")
            else:
                apply_diff(folder / name, block.text)

    def run(self, *words: str) -> str:
        """Run Python with this copy of the package; returns what it said."""
        done = subprocess.run(
            [sys.executable, *words],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": str(self.folder)},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
        return done.stdout + done.stderr

    def cohdc(self, *words: str) -> str:
        return self.run("-m", "cohdc_train", *words)


@pytest.mark.parametrize("page", RECIPES, ids=lambda page: page.stem)
def test_recipe_is_under_fifty_lines(page: Path) -> None:
    lines = [line for block in changes(page.stem) for line in block.text.splitlines()]
    added = [line for line in lines if not line.startswith("-")]
    assert len(added) < MOST_LINES
    assert bool(added) == (page.stem != "index")


def test_backbone_of_the_recipe_trains(tmp_path: Path) -> None:
    checkout = Checkout(tmp_path, "backbone")
    code = """
import torch
from cohdc_train.models import MaskRCNN, NetworkConfig
small = {"canvas": (64, 64), "fpn_channels": 8, "fc": 16, "proposals": (20, 10)}
config = NetworkConfig(backbone="plain_net", **small)
network = MaskRCNN(1, config)
body = network.backbone.body
assert type(body).__name__ == "PlainNet"
print([tuple(f.shape[1:]) for f in body(torch.zeros(2, 3, 64, 64)).values()], body.rates()[3])
sum(f.mean() for f in network.features(torch.rand(2, 3, 64, 64)).values()).backward()
print(bool(body.first[0].weight.grad.abs().sum() > 0))
"""
    shapes, gradient = checkout.run("-c", code).splitlines()[-2:]
    assert shapes == "[(32, 16, 16), (64, 8, 8), (128, 4, 4), (256, 2, 2)] (1, 1)"
    assert gradient == "True"


def test_converter_of_the_recipe_converts(tmp_path: Path) -> None:
    checkout = Checkout(tmp_path, "converter")
    photos = tmp_path / "photos"
    photos.mkdir()
    rows = []
    for i in range(4):
        cv2.imwrite(str(photos / f"{i}.png"), np.full((48, 64, 3), 30 * i, np.uint8))
        rows.append(f"{i}.png,car,10,10,{30 + i},40")
    (photos / "boxes.csv").write_text("\n".join([*rows, "0.png,car,1,2,three,4"]))
    said = checkout.cohdc("data", "convert", "boxes_csv", "photos/boxes.csv", "DATA")
    assert "no box of four numbers: photos/boxes.csv:5" in said
    splits = [
        json.loads((tmp_path / f"DATA/instances_{s}.json").read_text()) for s in ("train", "val")
    ]
    boxes = [row["bbox"] for split in splits for row in split["annotations"]]
    assert sorted(boxes) == [[10, 10, 20 + i, 30] for i in range(4)]
    assert splits[0]["categories"] == [{"id": 1, "name": "car"}]


def write_detector(path: Path) -> None:
    """Write a model with the recipe's outputs that always reports one box."""
    tensors = {
        "boxes": np.array([[16, 16, 48, 48], [0, 0, 9, 9]], np.float32),
        "scores": np.array([0.9, 0.01], np.float32),
    }
    constants = [
        helper.make_node("Constant", [], [name], value=numpy_helper.from_array(value))
        for name, value in tensors.items()
    ]
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, value.shape)
        for name, value in tensors.items()
    ]
    image = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 64, 64])
    graph = helper.make_graph(constants, "detector", [image], outputs)
    opset = helper.make_opsetid("", 18)
    onnx.save(helper.make_model(graph, opset_imports=[opset], ir_version=9), path)


def test_adapter_of_the_recipe_detects(tmp_path: Path) -> None:
    checkout = Checkout(tmp_path, "onnx-adapter")
    write_detector(tmp_path / "boxes.onnx")
    cv2.imwrite(str(tmp_path / "photo.png"), np.full((128, 128, 3), 90, np.uint8))
    checkout.cohdc("predict", "photo.png", "--model", "boxes.onnx", "--out", "found")
    (row,) = json.loads((tmp_path / "found" / "predictions.json").read_text())["annotations"]
    np.testing.assert_allclose(row["bbox"], [32, 32, 64, 64], atol=1.0)


def test_camera_source_of_the_recipe_is_tracked(tmp_path: Path) -> None:
    checkout = Checkout(tmp_path, "camera-source")
    recording = tmp_path / "recording"
    recording.mkdir()
    (recording / "camera.yaml").write_text(CAMERA_YAML)
    for i, pose in enumerate(camera_path(8)):
        rgb, depth_m, _ = render(room(), pose)
        np.savez(recording / f"frame_{i:04d}.npz", rgb=rgb, depth_m=depth_m, t=i / 30)
    checkout.run("my_camera.py", "recording", "run")
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (metrics["frames"], metrics["coverage"]) == (8, 1.0)


@pytest.mark.slow
def test_dataset_preset_of_the_recipe_is_trained_on(tmp_path: Path) -> None:
    checkout = Checkout(tmp_path, "dataset-preset")
    street = tmp_path / "street"
    for split, count in (("train", 4), ("test", 2)):
        content = coco_toys.content(street / "frames", split, count)
        coco_toys.write(street / "labels" / f"{split}.json", content)
    small = ("--trainer.max_steps=1", "--trainer.accelerator=cpu", "--data.workers=0")
    checkout.cohdc("fit", "--config", "street.yaml", "--out", "run", *small)
    config = (tmp_path / "run" / "config.yaml").read_text()
    assert "train_json: street/labels/train.json" in config
    assert (tmp_path / "run" / "best.ckpt").is_file()
