"""Batches: shapes, types, ranges, and repeatability for a seed."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import coco_toys as toys
import cv2
import numpy as np
import pytest
import torch

from cohdc_train.data.datamodule import CocoDataModule, Subset, TrainBatch
from cohdc_train.data.transforms import Augmentation
from cohdc_train.errors import DataError

CANVAS = (40, 56)


def module(root: Path, **more: Any) -> CocoDataModule:
    options: dict[str, Any] = {"canvas": CANVAS, "batch_size": 3, "workers": 0, **more}
    return CocoDataModule(root, **options)


def test_classes_come_from_the_file(tmp_path: Path) -> None:
    data = module(toys.folder(tmp_path))
    assert (data.class_names, data.num_classes) == (["person", "car"], 2)
    assert data.val_ground_truth["categories"] == [
        {"id": 1, "name": "person"},
        {"id": 2, "name": "car"},
    ]


def test_training_batch_has_the_promised_shapes(tmp_path: Path) -> None:
    data = module(toys.folder(tmp_path))
    torch.manual_seed(1)
    batches = list(data.train_dataloader())
    assert [len(batch.targets) for batch in batches] == [3, 3]
    for batch in batches:
        assert batch.images.shape == (3, 3, *CANVAS)
        assert batch.images.dtype == torch.uint8
        for target in batch.targets:
            n = len(target["labels"])
            assert target["boxes"].shape == (n, 4)
            assert target["boxes"].dtype == torch.float32
            assert target["masks"].shape == (n, *CANVAS)
            assert target["masks"].dtype == torch.uint8
            assert target["ignore"].shape == (0, 4)
            assert set(target["labels"].tolist()) <= {1, 2}
    assert sorted(target["image_id"] for batch in batches for target in batch.targets) == [
        1,
        2,
        3,
        4,
        5,
        6,
    ]


@pytest.mark.parametrize("photometric", [True, False])
def test_after_the_transfer_images_are_unit_floats(tmp_path: Path, photometric: bool) -> None:
    data = module(
        toys.folder(tmp_path),
        augment=Augmentation(photometric=photometric, scale_jitter=(0.5, 0.6)),
    )
    torch.manual_seed(0)
    before = next(iter(data.train_dataloader()))
    after = data.on_after_batch_transfer(before, 0)
    assert isinstance(after, TrainBatch)
    assert after.images.dtype == torch.float32
    assert 0 <= float(after.images.min()) < float(after.images.max()) <= 1
    for image, target in zip(after.images, after.targets, strict=True):
        height, width = target["size"]
        assert height < CANVAS[0]
        assert (image[:, height:] == 0).all()
        assert (image[:, :, width:] == 0).all()
    same = torch.equal(after.images, before.images.float() / 255)
    assert same is not photometric


def test_objects_cropped_away_are_dropped_with_their_labels(tmp_path: Path) -> None:
    data = module(toys.folder(tmp_path), augment=Augmentation(scale_jitter=(3.0, 3.0)))
    torch.manual_seed(0)
    targets = [
        target for _ in range(4) for batch in data.train_dataloader() for target in batch.targets
    ]
    assert {len(target["labels"]) for target in targets} >= {0, 1}
    for target in targets:
        assert (target["boxes"][:, 2:] > target["boxes"][:, :2]).all()
        assert len(target["masks"]) == len(target["labels"]) == len(target["boxes"])


def test_crowd_becomes_ignore_boxes(tmp_path: Path) -> None:
    root = toys.folder(tmp_path)
    path = root / "instances_train.json"
    value = json.loads(path.read_text())
    value["annotations"][0]["iscrowd"] = 1
    toys.write(path, value)
    data = module(root, augment=Augmentation(0.0, (1.0, 1.0)))
    targets = {t["image_id"]: t for batch in data.train_dataloader() for t in batch.targets}
    scale = CANVAS[0] / toys.HEIGHT
    expected = torch.tensor([[3, 4, 19, 28]]) * scale
    assert torch.allclose(targets[1]["ignore"], expected, atol=0.5)
    assert targets[1]["labels"].tolist() == [2]
    assert len(targets[2]["ignore"]) == 0


def test_validation_images_are_untouched(tmp_path: Path) -> None:
    data = module(toys.folder(tmp_path))
    (batch,) = list(data.val_dataloader())
    assert [image_id for _, image_id in batch] == [1, 2]
    assert batch[0][0].shape == (3, toys.HEIGHT, toys.WIDTH)
    assert tuple(batch[0][0][:, 30, 40].tolist()) == toys.COLORS[10]
    assert data.on_after_batch_transfer(batch, 0) is batch


@pytest.mark.filterwarnings(
    "ignore:This DataLoader will create 2 worker processes"
)  # torch's advice on one core
@pytest.mark.parametrize("workers", [0, 2])
def test_same_seed_gives_the_same_batches(tmp_path: Path, workers: int) -> None:
    root = toys.folder(tmp_path)
    runs = []
    for seed in (5, 5, 6):
        torch.manual_seed(seed)
        batches = list(module(root, workers=workers).train_dataloader())
        runs.append(torch.cat([batch.images for batch in batches]))
    assert torch.equal(runs[0], runs[1])
    assert not torch.equal(runs[0], runs[2])


def test_subsets_and_several_roots(tmp_path: Path) -> None:
    roots = [toys.folder(tmp_path / "a"), toys.folder(tmp_path / "b")]
    data = CocoDataModule(roots, ["person"], CANVAS, subset=Subset(train=2, val=1), workers=0)
    assert len(data.train_dataloader().dataset) == 4  # type: ignore[arg-type]
    assert len(data.val_dataloader().dataset) == 1  # type: ignore[arg-type]
    with pytest.raises(DataError, match="asked for"):
        _ = CocoDataModule(roots[0], subset=Subset(val=3)).folder


_PEAK = """
import resource, sys
import torch
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.models import MaskRCNN
from cohdc_train.models import NetworkConfig

torch.set_num_threads(1)
data = CocoDataModule(sys.argv[1], canvas=(256, 384), batch_size=1, workers=0)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
torch.manual_seed(0)
batch = next(iter(data.train_dataloader()))
config = NetworkConfig(depth=18, width=0.25, fpn_channels=16, fc=32, canvas=(256, 384))
network = MaskRCNN(2, config)
losses = network.losses(batch.images.float() / 255, batch.targets)
sum(losses.values()).backward()
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(len(batch.targets[0]["labels"]), (after - before) // 1024)
"""


@pytest.mark.slow
def test_hundreds_of_objects_on_a_large_image_take_little_memory(tmp_path: Path) -> None:
    """All masks at the image's size would be 9.6 GB."""
    root, height, width = toys.folder(tmp_path), 4000, 6000
    cv2.imwrite(str(root / "images" / "large.jpg"), np.full((height, width, 3), 120, np.uint8))
    rows = [
        toys.rectangle(1, 10, (i % 20 * 290, i // 20 * 190, 250, 160), i + 1) for i in range(400)
    ]
    image = {"id": 1, "file_name": "large.jpg", "height": height, "width": width}
    toys.write(
        root / "instances_train.json",
        {"images": [image], "annotations": rows, "categories": toys.CATEGORIES},
    )
    done = subprocess.run(
        [sys.executable, "-c", _PEAK, str(root)], capture_output=True, text=True, check=True
    )
    objects, mebibytes = (int(word) for word in done.stdout.split())
    assert objects > 100
    assert mebibytes < 1000


def test_paste_roots_are_pasted_and_not_trained_on(tmp_path: Path) -> None:
    root, others = toys.folder(tmp_path / "a", train=2), toys.folder(tmp_path / "b", train=5)
    augment = Augmentation(copy_paste=1.0, scale_jitter=(1.0, 1.0))
    data = module(root, paste_roots=[others], augment=augment)
    assert len(data.paste_sources) == 2
    (batch,) = list(data.train_dataloader())
    assert sorted(target["image_id"] for target in batch.targets) == [1, 2]
    with pytest.raises(DataError, match="pasted nowhere"):
        module(root, paste_roots=[others])
    rows = json.loads((others / "instances_train.json").read_text())
    rows["categories"][0]["name"] = "lorry"
    toys.write(others / "instances_train.json", rows)
    with pytest.raises(DataError, match="lorry"):
        _ = module(root, paste_roots=[others], augment=augment).paste_sources
