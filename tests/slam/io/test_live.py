"""Live sources: a growing folder, a camera of the caller, and Ctrl-C."""

import json
import os
import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest
from plane_world import CAMERA, camera_path, render, room, write_sequence

from cohdc_train.errors import DataError
from cohdc_train.slam.config import SlamConfig
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.io.growing_sequence import GrowingSequence
from cohdc_train.slam.io.live import CameraFrame, LiveCamera
from cohdc_train.slam.io.sources import rgbd_format
from cohdc_train.slam.io.tum import TimestampedImage
from cohdc_train.slam.run import run_slam, slam

FRAMES = 12
SMALL = SlamConfig().override({"features.max_keypoints": 400})


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a recorded sequence."""
    return write_sequence(tmp_path_factory.mktemp("live") / "room", FRAMES)


class Writer(threading.Thread):
    """Thread that writes a recorded sequence again, images and lines in two halves each."""

    def __init__(self, recorded: Path, folder: Path, pause: float = 0.004) -> None:
        super().__init__()
        self.folder, self._pause = folder, pause
        for name in ("rgb", "depth"):
            (folder / name).mkdir(parents=True)
        shutil.copy(recorded / "camera.yaml", folder)
        self._recorded = recorded

    def _lines(self, kind: str) -> list[str]:
        return (self._recorded / f"{kind}.txt").read_text().splitlines()

    def run(self) -> None:
        rows = [
            (kind, line)
            for pair in zip(*(self._lines(kind) for kind in ("rgb", "depth")), strict=True)
            for kind, line in zip(("rgb", "depth"), pair, strict=True)
        ]
        for kind, line in rows:
            with (self.folder / f"{kind}.txt").open("a") as file:
                file.write(line[:9])
                file.flush()
                time.sleep(self._pause)
                file.write(line[9:] + "\n")
            if not line.startswith("#"):
                content = (self._recorded / line.split()[1]).read_bytes()
                with (self.folder / line.split()[1]).open("wb") as file:
                    for part in (content[: len(content) // 2], content[len(content) // 2 :]):
                        file.write(part)
                        file.flush()
                        time.sleep(self._pause)
        (self.folder / "done").touch()


def test_growing_folder_gives_the_trajectory_of_the_complete_one(
    recorded: Path, tmp_path: Path
) -> None:
    writer = Writer(recorded, tmp_path / "room")
    writer.start()
    live = slam(tmp_path / "room", out=tmp_path / "run", settings=SMALL, follow=True)
    writer.join()
    whole = slam(recorded, out=tmp_path / "whole", settings=SMALL)
    assert live["frames"] == whole["frames"] == FRAMES
    assert live["without_depth"] == 0
    files = [(tmp_path / name / "trajectory.txt").read_bytes() for name in ("run", "whole")]
    assert files[0] == files[1], "the same bits"
    assert {"map.ply", "metrics.json", "pictures"} <= {
        path.name for path in (tmp_path / "run").iterdir()
    }


def read_growing(folder: Path, idle_timeout_s: float = 0.2) -> list[RGBDFrame]:
    """Read a growing sequence to its end."""
    return list(GrowingSequence(folder, CAMERA, rgbd_format(CAMERA), idle_timeout_s))


def test_idle_folder_ends_and_unpaired_images_are_counted(recorded: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(recorded, tmp_path / "room"))
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(line for i, line in enumerate(lines) if i != 4))
    source = GrowingSequence(folder, CAMERA, rgbd_format(CAMERA), 0.2)
    start = time.monotonic()
    frames = list(source)
    assert 0.2 <= time.monotonic() - start < 5
    assert len(frames) == FRAMES - 1
    assert source.num_unpaired == 1
    steps = np.diff([frame.timestamp for frame in frames])
    np.testing.assert_allclose(steps.max(), 2 / 30, atol=1e-5)


def test_folder_without_a_frame_is_an_error_and_leaves_no_results(tmp_path: Path) -> None:
    (tmp_path / "rgbd_dataset_freiburg1_none").mkdir()
    with pytest.raises(DataError, match="no frame came"):
        slam(
            tmp_path / "rgbd_dataset_freiburg1_none",
            out=tmp_path / "run",
            follow=True,
            idle_timeout=0.1,
        )
    assert [path.name for path in tmp_path.iterdir()] == ["rgbd_dataset_freiburg1_none"]


def test_idle_timeout_below_zero_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="idle_timeout is -1"):
        read_growing(tmp_path, idle_timeout_s=-1)


def test_camera_may_reuse_its_buffer() -> None:
    buffer = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)

    def frames() -> Iterator[CameraFrame]:
        for k in range(3):
            buffer[:] = k
            yield buffer, np.zeros(buffer.shape[:2], np.float32), float(k)

    seen = list(LiveCamera(CAMERA, frames()))
    assert [int(frame.rgb[0, 0, 0]) for frame in seen] == [0, 1, 2]


def test_later_broken_line_or_image_is_reported_and_skipped(
    recorded: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cohdc_train.slam.io.growing_sequence._IMAGE_TIMEOUT_S", 0.1)
    folder = Path(shutil.copytree(recorded, tmp_path / "room"))
    lines = (folder / "rgb.txt").read_text().splitlines()
    broken = folder / lines[6].split()[1]
    broken.write_bytes(broken.read_bytes()[:-7])
    (folder / "rgb.txt").write_text("\n".join([*lines[:3], "oh dear me", *lines[3:]]))
    (folder / "done").touch()
    assert len(read_growing(folder)) == FRAMES - 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2
    assert "rgb.txt:4: expected 'timestamp filename'" in said[0]
    assert f"{broken.name}: missing or incomplete" in said[1]


def test_first_image_of_another_size_is_an_error(recorded: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(recorded, tmp_path / "room"))
    (folder / "done").touch()
    for file in (folder / "rgb").iterdir():
        cv2.imwrite(str(file), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(DataError, match="image is 10x10, but the camera is 320x240"):
        read_growing(folder)


def test_nearest_partner_is_used_once(tmp_path: Path) -> None:
    color, depth = [0.0, 0.033, 0.066, 0.100], [0.004, 0.030, 0.031, 0.085, 0.119]
    for name, stamps in (("rgb.txt", color), ("depth.txt", depth)):
        (tmp_path / name).write_text("".join(f"{t:.3f} {t:.3f}.dat\n" for t in stamps))
        for t in stamps:
            (tmp_path / f"{t:.3f}.dat").write_bytes(b"anything")
    (tmp_path / "done").touch()
    pairs = []

    def make_frame(first: TimestampedImage, second: TimestampedImage) -> RGBDFrame:
        pairs.append((first.timestamp, second.timestamp))
        rgb, depth = np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32)
        return RGBDFrame(first.timestamp, rgb, depth)

    recording_format = replace(rgbd_format(CAMERA), make_frame=make_frame)
    assert len(list(GrowingSequence(tmp_path, CAMERA, recording_format, 1))) == 4
    assert pairs == [(0.0, 0.004), (0.033, 0.031), (0.066, 0.085), (0.1, 0.119)]


def frames(count: int) -> Iterator[CameraFrame]:
    """Render frames of a room whose upper rows have no depth."""
    for index, T_wc in enumerate(camera_path(count)):
        rgb, depth, _ = render(room(), T_wc)
        depth[:5] = np.nan
        yield rgb, depth, index / 30


def test_camera_of_the_caller_is_tracked(tmp_path: Path) -> None:
    seen: list[FrameResult] = []
    metrics = run_slam(
        LiveCamera(CAMERA, frames(FRAMES)),
        out=tmp_path / "run",
        settings=SMALL,
        observers=[lambda frame, result, point_map: seen.append(result)],
    )
    assert metrics["coverage"] == 1.0
    assert [result.timestamp for result in seen] == [index / 30 for index in range(FRAMES)]
    assert all(result.is_tracked and result.union_mask is None for result in seen)
    assert (tmp_path / "run" / "trajectory.txt").read_text().count("\n") == FRAMES + 1


class RealSense(ModuleType):
    """Stand-in for pyrealsense2 as the how-to page uses it: a camera of five frames."""

    def __init__(self) -> None:
        super().__init__("pyrealsense2")
        lens = SimpleNamespace(
            fx=260.0, fy=260.0, ppx=159.5, ppy=119.5, width=320, height=240, coeffs=[0.0] * 5
        )
        stream = SimpleNamespace(
            as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: lens)
        )
        sensor = SimpleNamespace(get_depth_scale=lambda: 0.001)
        device = SimpleNamespace(first_depth_sensor=lambda: sensor)
        profile = SimpleNamespace(get_device=lambda: device, get_stream=lambda _: stream)
        coming = frames(5)
        self.stream = SimpleNamespace(depth=1, color=2)
        self.format = SimpleNamespace(z16=1, rgb8=2)
        self.align = lambda _: SimpleNamespace(process=lambda pair: pair)
        self.config = lambda: SimpleNamespace(enable_stream=lambda *_: None)
        self.pipeline = lambda: SimpleNamespace(
            start=lambda _: profile, wait_for_frames=lambda: self._next(coming)
        )

    def _next(self, coming: Iterator[CameraFrame]) -> SimpleNamespace:
        try:
            rgb, depth, t = next(coming)
        except StopIteration:
            raise DataError("the camera was unplugged") from None
        color = SimpleNamespace(get_data=lambda: rgb)
        units = SimpleNamespace(get_data=lambda: np.nan_to_num(1000 * depth).astype(np.uint16))
        times = {"get_timestamp": lambda: 1000 * t}
        return SimpleNamespace(
            get_color_frame=lambda: color, get_depth_frame=lambda: units, **times
        )


def test_example_of_the_documentation_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = Path(__file__).parents[3] / "docs" / "how-to" / "live-camera.md"
    text = page.read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    monkeypatch.setitem(sys.modules, "pyrealsense2", RealSense())
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "docs/live.md", "exec"), {})
    metrics = json.loads((tmp_path / "runs" / "realsense" / "metrics.json").read_text())
    assert (metrics["frames"], metrics["coverage"]) == (5, 1.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rgb, depth, t: (rgb[:-1], depth, t), "the camera is 320x240"),
        (lambda rgb, depth, t: (rgb.astype(np.float32), depth, t), "float32"),
        (lambda rgb, depth, t: (rgb, depth, 0.0), "does not come after"),
    ],
    ids=["size", "type", "time"],
)
def test_frame_that_does_not_fit_the_camera_is_an_error(
    tmp_path: Path, change: object, message: str
) -> None:
    assert callable(change)
    altered = (change(*frame) for frame in frames(2))
    with pytest.raises(DataError, match=message):
        list(LiveCamera(CAMERA, altered))


def test_results_are_written_when_the_camera_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def failing() -> Iterator[CameraFrame]:
        yield from frames(4)
        raise DataError("the cable is out")

    metrics = run_slam(LiveCamera(CAMERA, failing()), tmp_path / "run", settings=SMALL)
    assert metrics["frames"] == 4
    assert "ended: the cable is out" in capsys.readouterr().err
    assert (tmp_path / "run" / "map.ply").exists()


def test_ctrl_c_ends_a_live_run_after_the_current_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, seen = signal.getsignal(signal.SIGINT), []

    def interrupt(frame: RGBDFrame, result: object, point_map: object) -> None:
        seen.append(frame.timestamp)
        if len(seen) == 3:
            signal.raise_signal(signal.SIGINT)

    camera = LiveCamera(CAMERA, frames(1000))
    metrics = run_slam(camera, tmp_path / "run", settings=SMALL, observers=[interrupt])
    assert metrics["frames"] == len(seen) == 3
    assert "stopping; Ctrl-C again" in capsys.readouterr().err
    assert (tmp_path / "run" / "trajectory.txt").exists()
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_ends_the_wait_for_further_frames(recorded: Path, tmp_path: Path) -> None:
    seen = []

    def interrupt_later(frame: RGBDFrame, result: object, point_map: object) -> None:
        seen.append(frame.timestamp)
        if len(seen) == FRAMES:
            threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()

    source = GrowingSequence(recorded, CAMERA, rgbd_format(CAMERA), idle_timeout_s=600)
    metrics = run_slam(source, tmp_path / "run", settings=SMALL, observers=[interrupt_later])
    assert metrics["frames"] == FRAMES
