"""Two gloo processes train as one does, and neither waits for ever for the other."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import coco_toys
import pytest
import torch
import yaml

HERE = Path(__file__).parent
TIMEOUT_S = (
    240  # several times what a run takes; a rank that waits for another waits for half an hour
)
STEPS = 6
TOLERANCE = 2e-6  # of the loss, relative; 1.2e-7 measured
# Nothing here is drawn or depends on who else is in the batch: 255 anchors are fewer than the 256
# that train the RPN, objects of 6 px are found by no proposal, so that the true boxes are the
# positive ones, and every image has two.
EXACT: dict[str, Any] = {
    "data": {
        "canvas": [32, 32],
        "workers": 0,
        "augment": {"flip": 0.0, "scale_jitter": [1, 1], "photometric": False},
    },
    "model": {
        "network": {
            **{
                "depth": 18,
                "width": 0.125,
                "fpn_channels": 8,
                "fc": 16,
                "anchor_scales": [16, 32, 64, 128],
            },
            **{"norm": "frozen", "rois": 64, "proposals": [10, 10]},
        },
        "optimizer": {"name": "sgd", "lr": 0.02, "warmup_steps": 0},
    },
    "trainer": {
        **{"accelerator": "cpu", "precision": "32-true", "logger": False},
        **{"enable_model_summary": False, "enable_progress_bar": False},
    },
}


def folder(root: Path, boxes: dict[str, list[tuple[tuple[int, int], ...]]]) -> Path:
    """Write toy images with a person and a car of 12 px each.

    boxes: by split, per image the corners of its objects.
    """
    for split, images in boxes.items():
        files, rows = [], []
        for i, corners in enumerate(images, 1):
            drawn = [
                coco_toys.rectangle(i, 10 * (j + 1), (*corner, 12, 12), 0)
                for j, corner in enumerate(corners)
            ]
            coco_toys.draw_image(
                root / "images" / f"{split}_{i}.png", drawn, seed=len(split) * 100 + i
            )
            rows += [row | {"id": len(rows) + k} for k, row in enumerate(drawn, 1)]
            files.append({"id": i, "file_name": f"{split}_{i}.png", "height": 48, "width": 64})
        content = {"images": files, "annotations": rows, "categories": coco_toys.CATEGORIES}
        coco_toys.write(root / f"instances_{split}.json", content)
    return root


def fit(
    root: Path, out: Path, processes: int, batch_size: int, apart: bool = False
) -> list[dict[str, Any]]:
    """Run `cohdc fit` in processes of its own; returns what the probe wrote, rank by rank."""
    config = yaml.safe_load(yaml.safe_dump(EXACT))
    config["data"] |= {"root": str(root), "batch_size": batch_size}
    config["trainer"] |= {"devices": processes, "max_epochs": STEPS} | (
        {"strategy": "ddp"} if processes > 1 else {}
    )
    probe = {
        "class_path": "distributed_probe.Probe",
        "init_args": {"folder": str(out), "apart": apart},
    }
    config["trainer"]["callbacks"] = [probe]
    out.mkdir(parents=True)
    (out / "run.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    places = os.pathsep.join(
        [str(HERE), str(HERE.parent / "data"), *filter(None, [os.environ.get("PYTHONPATH")])]
    )
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "cohdc_train",
            "fit",
            "--config",
            str(out / "run.yaml"),
            "--out",
            str(out),
        ],
        **{
            "cwd": HERE.parents[1],
            "env": {**os.environ, "PYTHONPATH": places, "OMP_NUM_THREADS": "1"},
        },
        **{"capture_output": True, "text": True, "timeout": TIMEOUT_S},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return [torch.load(out / f"rank{rank}.pt") for rank in range(processes)]


def curve(ranks: list[dict[str, Any]]) -> torch.Tensor:
    """Return [steps] the loss, mean over the ranks."""
    return torch.tensor([rank["losses"] for rank in ranks]).mean(dim=0)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    boxes = {
        "train": [((4 + 9 * i, 8 + 5 * i), (44 - 11 * i, 30 - 6 * i)) for i in range(4)],
        "val": [((5 * i, 4), (30 + 4 * i, 24)) for i in range(3)],
    }
    return folder(tmp_path_factory.mktemp("toy"), boxes)


@pytest.fixture(scope="module")
def one(root: Path) -> list[dict[str, Any]]:
    return fit(root, root / "one", processes=1, batch_size=4)


@pytest.fixture(scope="module")
def two(root: Path) -> list[dict[str, Any]]:
    return fit(root, root / "two", processes=2, batch_size=2)


@pytest.mark.slow
def test_two_processes_equal_one_with_twice_the_batch(one: Any, two: Any) -> None:
    losses = curve(one)
    assert len(losses) == STEPS
    assert losses[-1] < 0.9 * losses[0]
    assert two[0]["losses"] != two[1]["losses"]  # each has images of its own
    torch.testing.assert_close(curve(two), losses, rtol=TOLERANCE, atol=0)


@pytest.mark.slow
def test_two_processes_end_with_the_weights_of_one(one: Any, two: Any) -> None:
    for name, weight in one[0]["weights"].items():
        assert torch.equal(two[0]["weights"][name], two[1]["weights"][name]), name
        torch.testing.assert_close(two[0]["weights"][name], weight, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_validation_counts_every_image_once(one: Any, two: Any) -> None:
    """Three images over two processes: one of them is given out twice."""
    scores = one[0]["scores"]
    assert 0.1 < scores["val/mIoU"] < 0.9
    assert 0.05 < scores["val/segm_AP"] < 0.9
    assert two[0]["scores"] == two[1]["scores"] == pytest.approx(scores, abs=1e-6)


@pytest.mark.slow
def test_gradients_that_are_not_averaged_are_detected(root: Path, one: Any) -> None:
    """Plant the fault: the first loss is equal and the later ones are not."""
    apart = fit(root, root / "apart", processes=2, batch_size=2, apart=True)
    off = (curve(apart) / curve(one) - 1).abs()
    assert off[0] < TOLERANCE
    assert off[1:].max() > 1e-3  # 1.2e-2 measured
    assert not all(
        torch.equal(weight, apart[1]["weights"][name])
        for name, weight in apart[0]["weights"].items()
    )


@pytest.mark.slow
def test_rank_without_an_object_finishes(tmp_path: Path) -> None:
    """One of two images has no object; every step, one of the two processes has nothing to find."""
    boxes = {"train": [((4, 8), (40, 20)), ()], "val": [((4, 8), (40, 20))]}
    ranks = fit(folder(tmp_path, boxes), tmp_path / "out", processes=2, batch_size=1)
    assert [len(rank["losses"]) for rank in ranks] == [STEPS, STEPS]
    assert all(
        torch.equal(weight, ranks[1]["weights"][name])
        for name, weight in ranks[0]["weights"].items()
    )
