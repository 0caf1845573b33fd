"""Masks and mapping beside tracking: nothing queues, and a late mask or map does no harm."""

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
from cohdc_train.slam.config import Method
from cohdc_train.slam.dynamics.mask_propagation import CarriedMasks, halve_mask
from cohdc_train.slam.frame import View
from cohdc_train.slam.geometry.se3 import exp_se3, to_local
from cohdc_train.slam.mapping.local_bundle_adjustment import Solution, close_window, open_window
from cohdc_train.slam.runtime.async_masks import AsyncMasks
from cohdc_train.slam.runtime.executors import worker_process
from cohdc_train.slam.tracking.tracker import Tracker
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory
from cohdc_train.types import Mask

LONG = 20.0  # s: no wait of a thread here takes that long unless it hangs


def view(index: int, rgb: np.ndarray | None = None, depth: np.ndarray | None = None) -> View:
    nothing = np.zeros((CAMERA.height, CAMERA.width), dtype=np.float32)
    black = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    t = 100 + index / 30
    return View(
        t,
        f"{t:.6f}",
        f"{index}",
        black if rgb is None else rgb,
        nothing if depth is None else depth,
    )


class Segmenter:
    """Takes as long as it is told to: it holds a frame until `finish`."""

    def __init__(self, outline: Callable[[View], Mask]) -> None:
        self.outline = outline
        self.allowed = threading.Semaphore(0)
        self.begun: list[str] = []
        self.changed = threading.Condition()

    def __call__(self, view: View) -> tuple[Mask, float]:
        with self.changed:
            self.begun.append(view.name)
            self.changed.notify_all()
        assert self.allowed.acquire(timeout=LONG)
        return self.outline(view), 7.0

    def wait_for(self, count: int) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.begun) >= count, LONG)


def wait_for_result(masks: AsyncMasks) -> None:
    """Until the worker has handed over what it was allowed to finish."""
    end = time.monotonic() + LONG
    while masks._results._item is None:
        assert time.monotonic() < end
        time.sleep(0.001)


def nothing_moves(view: View) -> Mask:
    return np.zeros(view.depth.shape, dtype=np.bool_)


def test_a_slow_segmenter_gets_the_newest_frame_and_no_queue() -> None:
    segmenter = Segmenter(nothing_moves)
    segmenter.allowed.release()
    with AsyncMasks(segmenter) as masks:
        masks(view(0))
        masks(view(1))
        segmenter.wait_for(2)
        for index in range(2, 8):
            masks(view(index))
        assert segmenter.begun == ["0", "1"], "what comes meanwhile does not queue"
        segmenter.allowed.release(2)
        wait_for_result(masks)
        masks(view(8))
        segmenter.wait_for(3)
    assert segmenter.begun == ["0", "1", "8"]
    np.testing.assert_allclose(masks.ages, [*np.arange(8) / 30, 7 / 30], atol=1e-9)


def test_a_mask_that_was_carried_on_is_as_wide_as_one_in_time() -> None:
    rgb, depth, _ = render(room(), camera_path(1)[0])
    box = np.zeros(depth.shape, dtype=np.bool_)
    box[40:80, 60:100] = True
    carried = CarriedMasks()
    job = carried.advance(view(0, rgb, depth))
    carried.renew(job, halve_mask(box), 10.0)
    in_time = carried.mask(job.view)
    assert in_time.sum() > 1.3 * box.sum(), "it has grown"
    for index in range(1, 8):
        job = carried.advance(view(index, rgb, depth))
    np.testing.assert_array_equal(carried.mask(job.view), in_time)


def test_what_the_segmenter_raises_is_raised_to_the_caller() -> None:
    def missing(view: View) -> tuple[Mask, float]:
        raise DataError(f"{view.name}.png: cannot be read")

    with AsyncMasks(missing) as masks, pytest.raises(DataError, match=r"0\.png"):
        masks(view(0))


class Late(Executor):
    """Does the work at once but says so only when asked for the fourth time."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        class Slow(Future):  # type: ignore[type-arg]
            asked = 0

            def done(self) -> bool:
                self.asked += 1
                return self.asked > 3

        job = Slow()
        job.set_result(function(*args, **kwargs))
        return job


FRAMES, DELAY = 40, 5


def run_late() -> tuple[Tracker, list[bool], list[float]]:
    """A passer-by whose masks come DELAY frames late, and bundle adjustment that comes four frames
    late.
    """
    worlds = [[*room(), passer_by(index)] for index in range(FRAMES)]
    rendered = [
        render(world, T_wc) for world, T_wc in zip(worlds, camera_path(FRAMES), strict=True)
    ]
    segmenter = Segmenter(lambda view: rendered[int(view.name)][2])
    tracker = Tracker(CAMERA, features=500, method=Method(global_adjustment=False), executor=Late())
    tracked, overlaps = [], []
    segmenter.allowed.release()
    with AsyncMasks(segmenter) as masks:
        for index, (rgb, depth, moving) in enumerate(rendered):
            if index and index % DELAY == 0:
                segmenter.allowed.release()
                wait_for_result(masks)
            mask = masks(view(index, rgb, depth))
            overlaps.append(float((mask & moving).sum() / moving.sum()))
            tracked.append(tracker.track(rgb, depth, index / 30, mask).tracked)
        segmenter.allowed.release()
    tracker.finish()
    return tracker, tracked, overlaps


def test_late_masks_and_late_mapping_lose_no_frame_and_no_accuracy() -> None:
    tracker, tracked, overlaps = run_late()
    assert all(tracked)
    assert min(overlaps) > 0.97
    truth = Trajectory(np.arange(FRAMES) / 30, camera_path(FRAMES))
    assert score(truth, Trajectory(*tracker.trajectory()))["ate_m"]["rmse"] < 0.006


def test_what_joined_the_map_during_an_adjustment_moves_along() -> None:
    tracker = Tracker(CAMERA, features=500)
    views = [render(room(), T_wc) for T_wc in camera_path(30)]
    for index, (rgb, depth, _) in enumerate(views):
        tracker.track(rgb, depth, index / 30)
    world = tracker.map
    newest, features = world.keyframes[-1], tracker.features
    assert features is not None
    window = open_window(world, newest)
    later = replace(
        newest,
        index=world.joined,
        T_cw=exp_se3(np.array([0.1, 0, 0, 0, 0.1, 0])) @ newest.T_cw,
        features=features,
        point_ids=np.full(len(features), -1),
    )
    world.add_keyframe(later)
    world.add_points(later, np.flatnonzero(features.depths > 0)[:20])
    step = exp_se3(np.array([0.02, -0.01, 0.03, 0.01, 0.02, 0.005]))
    between = later.T_cw @ np.linalg.inv(newest.T_cw)
    added = later.seen_points()
    assert len(added) == 20
    seen = to_local(later.T_cw, world.positions[added])
    good = np.ones(len(window.keypoints), dtype=np.bool_)
    good[-30:] = False
    before = np.count_nonzero(newest.point_ids >= 0)
    motion = close_window(
        world, window, Solution(step @ np.stack(window.poses), window.points + 0.01, good)
    )
    assert motion is not None
    np.testing.assert_allclose(newest.T_cw, step @ window.poses[-1])
    np.testing.assert_allclose(later.T_cw @ np.linalg.inv(newest.T_cw), between, atol=1e-9)
    np.testing.assert_allclose(to_local(later.T_cw, world.positions[added]), seen, atol=1e-9)
    assert np.count_nonzero(newest.point_ids >= 0) == before - 30, (
        "measurements that do not fit are forgotten"
    )
    assert (
        close_window(world, window, Solution(np.stack(window.poses), window.points, good)) is None
    ), "a solution for poses that somebody else has moved since is of no use"
    np.testing.assert_allclose(newest.T_cw, step @ window.poses[-1])


def test_a_terminals_ctrl_c_does_not_end_the_worker() -> None:
    before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a shell may have us ignore it
    try:
        with worker_process() as executor:
            os.kill(executor.submit(os.getpid).result(), signal.SIGINT)
            time.sleep(0.2)
            assert executor.submit(pow, 2, 3).result() == 8, (
                "what is left of the map is still adjusted"
            )
    finally:
        signal.signal(signal.SIGINT, before)


def test_the_workers_linear_algebra_has_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    with worker_process() as executor:
        pools = executor.submit(threadpool_info).result()
    assert {pool["num_threads"] for pool in pools if pool["user_api"] == "blas"} == {1}


def test_the_command_in_real_time_accounts_for_every_frame(tmp_path: Path) -> None:
    root, out = write_sequence(tmp_path / "walk", 24, with_passer_by=True), tmp_path / "out"
    arguments = [
        "slam",
        "--sequence",
        str(root),
        "--out",
        str(out),
        "--masks",
        str(root / "masks"),
        "--realtime",
    ]
    assert main([*arguments, "--features", "500"]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    with (out / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert metrics["realtime"] is True
    assert metrics["frames"] == 24 == len(rows) + metrics["dropped"]
    assert metrics["tracked"] == sum(row["tracked"] == "1" for row in rows)
    assert metrics["coverage"] == metrics["tracked"] / 24
    for key in ("latency_ms", "mask_age_ms", "segmenter_ms"):
        assert 0 <= metrics[key]["p50"] <= metrics[key]["p95"]
