"""Segmenter and mapping in parallel with tracking: no queue, and no harm by delays."""

import csv
import json
import os
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plane_world import CAMERA, camera_path, passer_by, render, room, write_sequence
from threadpoolctl import threadpool_info

from cohdc_train.cli import main
from cohdc_train.errors import DataError
from cohdc_train.slam.config import BundleAdjustmentConfig, SlamConfig
from cohdc_train.slam.dynamics.mask_propagation import PropagatedMask, downsample_mask
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.se3 import exp_se3, to_local
from cohdc_train.slam.mapping.local_bundle_adjustment import Solution, apply_solution, build_window
from cohdc_train.slam.runtime.async_masks import AsyncSegmenter
from cohdc_train.slam.runtime.executors import worker_process
from cohdc_train.slam.system import Slam
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory
from cohdc_train.types import Mask

TIMEOUT_S = 20.0  # of a wait for a thread, which is over long before


def make_frame(
    index: int, rgb: np.ndarray | None = None, depth: np.ndarray | None = None
) -> RGBDFrame:
    """Return a frame of a camera with 30 frames per second, black where no image is given."""
    size = (CAMERA.height, CAMERA.width)
    return RGBDFrame(
        timestamp=100 + index / 30,
        rgb=np.zeros((*size, 3), np.uint8) if rgb is None else rgb,
        depth=np.zeros(size, np.float32) if depth is None else depth,
        name=f"{index}",
    )


class GatedSegmenter:
    """Segmenter that finishes a frame when it is allowed to; started: names of its frames."""

    def __init__(self, segment: Callable[[RGBDFrame], Mask]) -> None:
        self.segment = segment
        self.allowed = threading.Semaphore(0)
        self.started: list[str] = []
        self.changed = threading.Condition()

    def __call__(self, frame: RGBDFrame) -> tuple[Mask, float]:
        with self.changed:
            self.started.append(frame.name)
            self.changed.notify_all()
        assert self.allowed.acquire(timeout=TIMEOUT_S)
        return self.segment(frame), 7.0

    def wait_for(self, count: int) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.started) >= count, TIMEOUT_S)


def wait_for_result(masks: AsyncSegmenter) -> None:
    """Wait until the thread has handed over a result."""
    end = time.monotonic() + TIMEOUT_S
    while masks._results._item is None:
        assert time.monotonic() < end
        time.sleep(0.001)


def no_dynamic_pixels(frame: RGBDFrame) -> Mask:
    """Return an empty mask."""
    return np.zeros(frame.depth.shape, dtype=np.bool_)


def test_slow_segmenter_gets_the_newest_frame_without_a_queue() -> None:
    segmenter = GatedSegmenter(no_dynamic_pixels)
    segmenter.allowed.release()
    with AsyncSegmenter(segmenter) as masks:
        masks(make_frame(0))
        masks(make_frame(1))
        segmenter.wait_for(2)
        for index in range(2, 8):
            masks(make_frame(index))
        assert segmenter.started == ["0", "1"], "frames that come meanwhile are not queued"
        segmenter.allowed.release(2)
        wait_for_result(masks)
        masks(make_frame(8))
        segmenter.wait_for(3)
    assert segmenter.started == ["0", "1", "8"]
    np.testing.assert_allclose(masks.ages, [*np.arange(8) / 30, 7 / 30], atol=1e-9)


def test_propagated_mask_is_dilated_like_one_in_time() -> None:
    rgb, depth, _ = render(room(), camera_path(1)[0])
    box = np.zeros(depth.shape, dtype=np.bool_)
    box[40:80, 60:100] = True
    propagated = PropagatedMask()
    job = propagated.advance(make_frame(0, rgb, depth))
    propagated.update(job, downsample_mask(box), 10.0)
    in_time = propagated.mask(job.frame)
    assert in_time.sum() > 1.3 * box.sum(), "the mask is dilated"
    for index in range(1, 8):
        job = propagated.advance(make_frame(index, rgb, depth))
    np.testing.assert_array_equal(propagated.mask(job.frame), in_time)


def test_error_of_the_segmenter_is_raised_to_the_caller() -> None:
    def missing(frame: RGBDFrame) -> tuple[Mask, float]:
        raise DataError(f"{frame.name}.png: cannot be read")

    with AsyncSegmenter(missing) as masks, pytest.raises(DataError, match=r"0\.png"):
        masks(make_frame(0))


class DelayedExecutor(Executor):
    """Executor whose jobs are done only when asked for the fourth time."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        class DelayedFuture(Future):  # type: ignore[type-arg]
            asked = 0

            def done(self) -> bool:
                self.asked += 1
                return self.asked > 3

        job = DelayedFuture()
        job.set_result(function(*args, **kwargs))
        return job


FRAMES, DELAY = 40, 5


def run_delayed() -> tuple[Trajectory, list[bool], list[float]]:
    """Track with masks that are DELAY frames late, and bundle adjustment that is four frames late.

    Returns the trajectory, whether each frame was tracked, and the covered share of the person.
    """
    worlds = [[*room(), passer_by(index)] for index in range(FRAMES)]
    rendered = [
        render(world, T_wc) for world, T_wc in zip(worlds, camera_path(FRAMES), strict=True)
    ]
    segmenter = GatedSegmenter(lambda frame: rendered[int(frame.name)][2])
    options = {"features.max_keypoints": 500, "bundle_adjustment.global_enabled": False}
    slam = Slam(CAMERA, SlamConfig().override(options), executor=DelayedExecutor())
    tracked, overlaps = [], []
    segmenter.allowed.release()
    with AsyncSegmenter(segmenter) as masks:
        for index, (rgb, depth, moving) in enumerate(rendered):
            if index and index % DELAY == 0:
                segmenter.allowed.release()
                wait_for_result(masks)
            frame = make_frame(index, rgb, depth)
            mask = masks(frame)
            overlaps.append(float((mask & moving).sum() / moving.sum()))
            tracked.append(slam.track(frame, mask).is_tracked)
        segmenter.allowed.release()
    return slam.finish(), tracked, overlaps


def test_delayed_masks_and_mapping_lose_no_frame_and_no_accuracy() -> None:
    estimate, tracked, overlaps = run_delayed()
    assert all(tracked)
    assert min(overlaps) > 0.97
    truth = Trajectory(100 + np.arange(FRAMES) / 30, camera_path(FRAMES))
    assert score(truth, estimate)["ate_m"]["rmse"] < 0.006


def test_keyframe_inserted_during_an_adjustment_moves_along() -> None:
    slam = Slam(CAMERA, SlamConfig().override({"features.max_keypoints": 500}))
    for index, T_wc in enumerate(camera_path(30)):
        rgb, depth, _ = render(room(), T_wc)
        features = slam.track(make_frame(index, rgb, depth)).features
    assert features is not None
    world = slam.map
    newest = world.keyframes[-1]
    window = build_window(world, newest, BundleAdjustmentConfig())
    later = replace(
        newest,
        index=world.num_inserted,
        T_cw=exp_se3(np.array([0.1, 0, 0, 0, 0.1, 0])) @ newest.T_cw,
        features=features,
        point_ids=np.full(len(features), -1),
    )
    world.add_keyframe(later)
    world.add_points(later, np.flatnonzero(features.depths > 0)[:20])
    step = exp_se3(np.array([0.02, -0.01, 0.03, 0.01, 0.02, 0.005]))
    between = later.T_cw @ np.linalg.inv(newest.T_cw)
    added = later.observed_point_ids()
    assert len(added) == 20
    seen = to_local(later.T_cw, world.positions[added])
    good = np.ones(len(window.keypoints), dtype=np.bool_)
    good[-30:] = False
    before = np.count_nonzero(newest.point_ids >= 0)
    motion = apply_solution(
        world, window, Solution(step @ np.stack(window.poses), window.points + 0.01, good)
    )
    assert motion is not None
    np.testing.assert_allclose(newest.T_cw, step @ window.poses[-1])
    np.testing.assert_allclose(later.T_cw @ np.linalg.inv(newest.T_cw), between, atol=1e-9)
    np.testing.assert_allclose(to_local(later.T_cw, world.positions[added]), seen, atol=1e-9)
    assert np.count_nonzero(newest.point_ids >= 0) == before - 30, "outliers are removed"
    assert (
        apply_solution(world, window, Solution(np.stack(window.poses), window.points, good)) is None
    ), "a solution for poses that have moved since is not applied"
    np.testing.assert_allclose(newest.T_cw, step @ window.poses[-1])


def test_ctrl_c_of_a_terminal_does_not_end_the_worker() -> None:
    before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a shell may have set it to be ignored
    try:
        with worker_process() as executor:
            os.kill(executor.submit(os.getpid).result(), signal.SIGINT)
            time.sleep(0.2)
            assert executor.submit(pow, 2, 3).result() == 8, "the worker still takes jobs"
    finally:
        signal.signal(signal.SIGINT, before)


def test_linear_algebra_of_the_worker_has_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    with worker_process() as executor:
        pools = executor.submit(threadpool_info).result()
    assert {pool["num_threads"] for pool in pools if pool["user_api"] == "blas"} == {1}


def test_real_time_run_accounts_for_every_frame(tmp_path: Path) -> None:
    root, out = write_sequence(tmp_path / "walk", 24, with_passer_by=True), tmp_path / "out"
    arguments = [
        "slam",
        str(root),
        "--out",
        str(out),
        "--masks",
        str(root / "masks"),
        "--realtime",
    ]
    assert main([*arguments, "--settings.features.max_keypoints", "500"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    with (out / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert metrics["realtime"] is True
    assert metrics["frames"] == 24 == len(rows) + metrics["dropped"]
    assert metrics["tracked"] == sum(row["tracked"] == "1" for row in rows)
    assert metrics["coverage"] == metrics["tracked"] / 24
    assert set(metrics["ms"]) == {"mask", "track", "map"}, "nobody waits for the segmenter"
    columns = ("segment_ms", "track_ms", "map_ms")
    busy_ms = sum(float(row[column]) for row in rows for column in columns)
    assert metrics["fps"] == pytest.approx(1e3 * len(rows) / busy_ms, rel=0.01)
    for key in ("latency_ms", "mask_age_ms", "segmenter_ms"):
        assert 0 <= metrics[key]["p50"] <= metrics[key]["p95"]
