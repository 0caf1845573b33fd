"""The whole way, tiny: a training, its ONNX file, and SLAM with that file, by the command line."""

import json
from pathlib import Path

import coco_toys
import numpy as np
import pytest
from plane_world import write_sequence

from cohdc_train.cli import main
from cohdc_train.trajectory.trajectory import Trajectory

pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)

FRAMES = 6
TINY = """
data: {canvas: [96, 128], workers: 0}
model:
  network: {depth: 18, width: 0.125, fpn_channels: 8, fc: 16, anchor_scales: [8, 16, 32, 64],
            rois: 16, proposals: [50, 20], score_threshold: 0.05}
trainer: {accelerator: cpu, max_epochs: 1, precision: 32-true}
figures: false
"""


def test_trained_network_is_exported_and_masks_frames_of_slam(tmp_path: Path) -> None:
    data = coco_toys.folder(tmp_path / "data")
    recording = write_sequence(tmp_path / "recording", FRAMES)
    config = tmp_path / "tiny.yaml"
    config.write_text(TINY, encoding="utf-8")
    training, model, run = (tmp_path / name for name in ("training", "model.onnx", "run"))

    words = ["--config", str(config), f"--data.root={data}", f"--out={training}"]
    assert main(["fit", *words]) == 0
    checkpoint, images = str(training / "best.ckpt"), str(data / "images")
    assert main(["export", checkpoint, "--out", str(model), "--images", images]) == 0
    assert main(["slam", str(recording), "--out", str(run), "--model", str(model)]) == 0

    parity = json.loads(model.with_name("model.onnx.json").read_text())
    assert parity["detections_compared"] > 0
    assert parity["mask_iou_min"] >= 0.99
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["frames"] == FRAMES
    assert metrics["ms"]["segment"]["p50"] > 0
    estimate = Trajectory.load_tum(run / "trajectory.txt")
    truth = Trajectory.load_tum(recording / "groundtruth.txt")
    np.testing.assert_array_equal(estimate.timestamps, truth.timestamps)
