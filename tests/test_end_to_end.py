"""The whole way, tiny: a training, its ONNX file, and SLAM with that file, by the command line."""

import csv
import json
from pathlib import Path

import numpy as np
from plane_world import write_sequence

from cohdc_train.cli import main
from cohdc_train.trajectory.trajectory import Trajectory

FRAMES = 6


def test_training_leaves_a_file_that_equals_its_checkpoint(fine_tuned: Path) -> None:
    parity = json.loads((fine_tuned / "model.onnx.json").read_text())
    assert parity["detections_compared"] > 20
    assert parity["mask_iou_min"] >= 0.99
    assert parity["max_difference"]["boxes"] <= 1e-2


def test_slam_tracks_with_the_masks_of_the_trained_network(
    fine_tuned: Path, tmp_path: Path
) -> None:
    recording, run = write_sequence(tmp_path / "recording", FRAMES), tmp_path / "run"
    words = ["slam", str(recording), "--out", str(run), "--model", str(fine_tuned / "model.onnx")]
    assert main([*words, "--settings.masks.min_score", "0.1"]) == 0  # of hardly trained classes

    metrics = json.loads((run / "metrics.json").read_text())
    assert (metrics["frames"], metrics["coverage"]) == (FRAMES, 1.0)
    assert metrics["ms"]["segment"]["p50"] > 0
    estimate = Trajectory.load_tum(run / "trajectory.txt")
    truth = Trajectory.load_tum(recording / "groundtruth.txt")
    np.testing.assert_array_equal(estimate.timestamps, truth.timestamps)
    with (run / "frames.csv").open() as file:
        shares = [float(row["culled_share"]) for row in csv.DictReader(file)]
    assert min(shares) > 0.05, "the network's masks remove keypoints"
