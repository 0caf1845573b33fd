#!/usr/bin/env python3
"""Measure memory and time of `cohdc slam` over minutes of a sequence played forth and back.

    tools/experiments/slam_memory.py --sequence DIR --out OUT [--frames 18000] [--features 500]
        [--shrink 2] [--settings OPTION=VALUE ...]

Frames come at 30 a second, images a --shrink-th as wide and high; they are read into memory first.
A line every --every frames: resident memory beyond that before the first frame, keyframes and
points the map holds, keyframes made since the line before, and CPU time per frame. Results go to
OUT as `cohdc slam` writes them; the truth goes forth and back, too. Rolling shutter and the time
between color and depth are skipped, for they would be wrong on the way back.
"""

import argparse
import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from slam_settings import add_settings_option

from cohdc_train.slam.config import SlamConfig
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.geometry.calibration import choose_camera
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.sources import RecordedSequence
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.run import run_slam
from cohdc_train.trajectory.association import associate
from cohdc_train.trajectory.trajectory import Trajectory

RATE = 30  # frames per second


def main() -> None:
    """Load, play, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sequence", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=18_000)
    parser.add_argument("--features", type=int, default=500)
    parser.add_argument("--shrink", type=int, default=2)
    parser.add_argument("--every", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    add_settings_option(parser)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    source = ForthAndBack(arguments.sequence, arguments.frames, arguments.shrink, arguments.out)
    options = {"features.max_keypoints": arguments.features, **arguments.settings}
    settings = SlamConfig(seed=arguments.seed).override(options)
    out = arguments.out / "run"
    metrics = run_slam(source, out, settings=settings, observers=[Table(arguments.every)])
    print(f"ATE RMSE {metrics['ate_m']['rmse']:.4f} m, coverage {100 * metrics['coverage']:.1f} %")


class ForthAndBack:
    """A recorded sequence as a source of any length."""

    def __init__(self, folder: Path, frames: int, shrink: int, out: Path) -> None:
        camera, _ = choose_camera(folder, None)
        recorded = RecordedSequence(folder, camera)
        self.camera = shrunk(camera, shrink)
        self.num_unpaired = 0
        self._images, stamps = [], []
        for view in recorded:
            self._images.append(small(view, self.camera, shrink))
            stamps.append(view.timestamp)
        count = len(stamps)
        period = [*range(count), *range(count - 2, 0, -1)]
        self._order = [period[i % len(period)] for i in range(frames)]
        self.groundtruth: Path | None = None
        if recorded.groundtruth is not None:
            self.groundtruth = out / "groundtruth.txt"
            truth = Trajectory.load_tum(recorded.groundtruth)
            self._truth(truth, np.array(stamps)).save_tum(self.groundtruth)

    def __len__(self) -> int:
        return len(self._order)

    def __iter__(self) -> Iterator[RGBDFrame]:
        for number, place in enumerate(self._order):
            rgb, depth = self._images[place]
            t = number / RATE
            meters = depth.astype(np.float32) / self.camera.depth_scale
            yield RGBDFrame(t, rgb.copy(), meters, name=f"{number}")

    def _truth(self, truth: Trajectory, stamps: np.ndarray) -> Trajectory:
        """Return the true pose of every image at the times when it is played."""
        row = dict(associate(stamps, truth.timestamps, 0.02).tolist())
        known = [
            (number / RATE, row[place]) for number, place in enumerate(self._order) if place in row
        ]
        times, rows = np.array(known).T
        return Trajectory(times, truth.poses[rows.astype(int)])


def shrunk(camera: Camera, by: int) -> Camera:
    """Return the camera of images whose sides are divided by `by`."""
    c = camera
    cx, cy = (c.cx + 0.5) / by - 0.5, (c.cy + 0.5) / by - 0.5
    size = {"width": c.width // by, "height": c.height // by}
    return replace(c, fx=c.fx / by, fy=c.fy / by, cx=cx, cy=cy, readout_s=0.0, **size)


def small(view: RGBDFrame, camera: Camera, by: int) -> tuple[np.ndarray, np.ndarray]:
    """Return color, and depth as it is stored."""
    rgb = cv2.resize(view.rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return rgb, np.rint(view.depth[by // 2 :: by, by // 2 :: by] * camera.depth_scale).astype(
        np.uint16
    )


class Table:
    """Watches a run and prints its lines."""

    def __init__(self, every: int) -> None:
        self._every = every
        self._frames = self._made = 0
        self._cpu = time.process_time()
        self._start = resident()
        print(
            "| frames | minutes | MB more | keyframes | points | keyframes made | CPU ms a frame |",
            flush=True,
        )
        print("|---|---|---|---|---|---|---|", flush=True)

    def __call__(self, frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        """Count the frame."""
        self._frames += 1
        self._made += result.is_keyframe
        if self._frames % self._every:
            return
        cpu, world = time.process_time(), point_map
        points = np.count_nonzero(world.num_observations[: world.size])
        cells = [self._frames, f"{self._frames / RATE / 60:.1f}", f"{resident() - self._start:.0f}"]
        cells += [
            len(world.keyframes),
            points,
            self._made,
            f"{1e3 * (cpu - self._cpu) / self._every:.1f}",
        ]
        print(f"| {' | '.join(map(str, cells))} |", flush=True)
        self._made, self._cpu = 0, cpu


def resident() -> float:
    """MB of memory this process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


if __name__ == "__main__":
    main()
