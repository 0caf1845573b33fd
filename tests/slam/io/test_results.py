"""Numbers of metrics.json from the records of a run."""

import numpy as np
import pytest

from cohdc_train.slam.frame import FrameRecord, FrameTiming
from cohdc_train.slam.io.results import compute_metrics
from cohdc_train.trajectory.trajectory import Trajectory


def record(is_keyframe: bool, mapping_ms: float) -> FrameRecord:
    """Return the record of a tracked frame that took 10 ms to track."""
    timing = FrameTiming(tracking_ms=10.0, mapping_ms=mapping_ms)
    return FrameRecord("0", True, is_keyframe, 100, 90, 0.0, timing)


def test_mapping_on_later_frames_counts_for_its_keyframe_and_for_the_speed() -> None:
    """In real time a keyframe is inserted in one frame, and the map adjusted in the next ones."""
    records = [record(True, 5.0), record(False, 30.0), record(False, 15.0), record(True, 20.0)]
    trajectory = Trajectory(np.arange(4.0), np.tile(np.eye(4), (4, 1, 1)))
    metrics = compute_metrics(records, trajectory, None)
    assert metrics["ms"]["map"]["p50"] == pytest.approx(35.0)
    assert metrics["fps"] == pytest.approx(1e3 * 4 / (4 * 10 + 70))
