"""Extreme but legal data trains in bounded memory: many objects, none, single pixels, panoramas."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import coco_toys as toys
import cv2
import numpy as np
import pytest

WIDE = (3000, 12000)  # px, height and width; one mask is 36 MB

# Setup, every training batch with a step on it, every validation image with its scores; prints the
# objects that were trained on, and by how much the peak memory grew, MiB: that of what was loaded
# before is no matter of the data.
_TRAIN = """
import sys
import torch
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.models import MaskRCNN
from cohdc_train.models import NetworkConfig
from cohdc_train.models import detect
from cohdc_train.metrics.coco_metrics import SegmentationMetrics

def peak():
    return int(open("/proc/self/status").read().partition("VmHWM:")[2].split()[0]) // 1024

torch.set_num_threads(1)
torch.manual_seed(0)
canvas = (96, 256)
data = CocoDataModule(sys.argv[1], canvas=canvas, batch_size=2, workers=0)
sizes = dict(depth=18, width=0.125, fpn_channels=8, fc=16)
config = dict(anchor_scales=(8, 16, 32, 64), score_threshold=0.0, **sizes)
network = MaskRCNN(2, NetworkConfig(canvas=canvas, rois=128, detections=100, **config))
before = peak()
data.setup("fit")
objects = 0
for batch in data.train_dataloader():
    batch = data.on_after_batch_transfer(batch, 0)
    total = sum(network.losses(batch.images, batch.targets).values())
    assert torch.isfinite(total)
    total.backward()
    objects += sum(len(target["labels"]) for target in batch.targets)
assert all(torch.isfinite(p.grad).all() for p in network.parameters())
trained = peak()
network.eval()
metrics = SegmentationMetrics(data.val_ground_truth)
for batch in data.val_dataloader():
    for (image, number), found in zip(batch, detect(network, [image for image, _ in batch])):
        metrics.update(number, found)
assert metrics.compute()["segm_AP"] >= 0
print(objects, trained - before, peak() - before)
"""


def folder(
    root: Path, images: list[list[tuple[int, int, int, int]]], size: tuple[int, int]
) -> Path:
    """Write a folder whose two splits are the same images.

    size: (height, width), px; images: the boxes of each.
    """
    (root / "images").mkdir(parents=True)
    files: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    pixels = np.full((*size, 3), 90, np.uint8)
    for i, boxes in enumerate(images, 1):
        cv2.imwrite(str(root / "images" / f"{i}.jpg"), pixels)
        files.append({"id": i, "file_name": f"{i}.jpg", "height": size[0], "width": size[1]})
        rows += [
            toys.rectangle(i, 10 + 10 * (k % 2), box, len(rows) + k)
            for k, box in enumerate(boxes, 1)
        ]
    content = {"images": files, "annotations": rows, "categories": toys.CATEGORIES}
    for split in ("train", "val"):
        toys.write(root / f"instances_{split}.json", content)
    return root


def train(root: Path) -> tuple[int, int, int]:
    """Return the number of objects, and the growth of peak memory by training and in all, MiB."""
    done = subprocess.run(
        [sys.executable, "-c", _TRAIN, str(root)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    objects, training, everything = (int(word) for word in done.stdout.split())
    return objects, training, everything


MANY = [(i % 25 * 25, i // 25 * 24, 20, 18) for i in range(500)]
TINY = [(i * 7, i * 5, 1, 1) for i in range(60)]


# Bounds in MiB; measured: 169, 83, 81, and 567 (248 in training; validation turns the image into
# float32).
@pytest.mark.slow
@pytest.mark.parametrize(
    ("images", "size", "least", "bound"),
    [
        pytest.param([MANY, MANY], (480, 640), 300, 350, id="500 objects"),
        pytest.param([MANY[:3], [], [], []], (480, 640), 0, 200, id="batches without an object"),
        pytest.param([TINY, TINY], (480, 640), 0, 200, id="objects of one pixel"),
        pytest.param(
            [[(400 * i, 50 * i, 900, 1200) for i in range(25)]], WIDE, 5, 1000, id="12000 px wide"
        ),
    ],
)
def test_hard_images_train_and_validate_in_bounded_memory(
    tmp_path: Path,
    images: list[list[tuple[int, int, int, int]]],
    size: tuple[int, int],
    least: int,
    bound: int,
) -> None:
    objects, training, everything = train(folder(tmp_path / "a", images, size))
    assert objects >= least
    assert training <= everything < bound
