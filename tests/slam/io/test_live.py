"""Frames that come while the run goes: a folder that grows, a camera of one's own, Ctrl-C."""

import json
import os
import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, render, room, write_sequence

from cohdc_train.errors import DataError
from cohdc_train.slam.frame import View
from cohdc_train.slam.io.growing_sequence import Followed
from cohdc_train.slam.io.live import Live
from cohdc_train.slam.io.sources import rgbd_layout
from cohdc_train.slam.io.tum import Entry
from cohdc_train.slam.run import run_source, slam

FRAMES = 12


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole sequence, to be written again piece by piece."""
    return write_sequence(tmp_path_factory.mktemp("live") / "room", FRAMES)


class Writer(threading.Thread):
    """Writes a recorded sequence once more: an image in two halves, then its line in two halves."""

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


def test_a_folder_that_grows_gives_what_the_whole_folder_gives(
    recorded: Path, tmp_path: Path
) -> None:
    writer = Writer(recorded, tmp_path / "room")
    writer.start()
    live = slam(sequence=tmp_path / "room", out=tmp_path / "run", features=400, follow=True)
    writer.join()
    whole = slam(sequence=recorded, out=tmp_path / "whole", features=400)
    assert live["frames"] == whole["frames"] == FRAMES
    assert live["without_depth"] == 0
    files = [(tmp_path / name / "trajectory.txt").read_bytes() for name in ("run", "whole")]
    assert files[0] == files[1], "bit for bit"
    assert {"map.ply", "metrics.json", "pictures"} <= {
        path.name for path in (tmp_path / "run").iterdir()
    }


def followed(folder: Path, idle: float = 0.2) -> list[View]:
    return list(Followed(folder, CAMERA, rgbd_layout(CAMERA), idle))


def test_silence_ends_it_and_what_has_no_partner_is_counted(recorded: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(recorded, tmp_path / "room"))
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(line for i, line in enumerate(lines) if i != 4))
    source = Followed(folder, CAMERA, rgbd_layout(CAMERA), 0.2)
    start = time.monotonic()
    views = list(source)
    assert 0.2 <= time.monotonic() - start < 5
    assert len(views) == FRAMES - 1
    assert source.without_depth == 1
    np.testing.assert_allclose(np.diff([view.t for view in views]).max(), 2 / 30, atol=1e-5)


def test_nothing_at_all_is_an_error_that_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "rgbd_dataset_freiburg1_none").mkdir()
    with pytest.raises(DataError, match="no frame came"):
        slam(
            sequence=tmp_path / "rgbd_dataset_freiburg1_none",
            out=tmp_path / "run",
            follow=True,
            idle=0.1,
        )
    assert [path.name for path in tmp_path.iterdir()] == ["rgbd_dataset_freiburg1_none"]


def test_a_silence_of_no_length_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="idle is -1"):
        followed(tmp_path, idle=-1)


def test_a_camera_may_fill_one_buffer_again_and_again() -> None:
    buffer = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)

    def frames() -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float32], float]]:
        for k in range(3):
            buffer[:] = k
            yield buffer, np.zeros(buffer.shape[:2], np.float32), float(k)

    assert [int(view.rgb[0, 0, 0]) for view in list(Live(CAMERA, frames()))] == [0, 1, 2]


def test_a_broken_line_or_image_later_on_is_told_and_left_out(
    recorded: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cohdc_train.slam.io.growing_sequence._PATIENCE", 0.1)
    folder = Path(shutil.copytree(recorded, tmp_path / "room"))
    lines = (folder / "rgb.txt").read_text().splitlines()
    broken = folder / lines[6].split()[1]
    broken.write_bytes(broken.read_bytes()[:-7])
    (folder / "rgb.txt").write_text("\n".join([*lines[:3], "oh dear me", *lines[3:]]))
    (folder / "done").touch()
    assert len(followed(folder)) == FRAMES - 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2
    assert "rgb.txt:4: expected 'timestamp filename'" in said[0]
    assert f"{broken.name}: not there, or not whole" in said[1]


def test_a_first_image_that_does_not_fit_the_camera_is_an_error(
    recorded: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(recorded, tmp_path / "room"))
    (folder / "done").touch()
    for file in (folder / "rgb").iterdir():
        cv2.imwrite(str(file), np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(DataError, match="image is 10x10, the camera says 320x240"):
        followed(folder)


def test_the_nearest_partner_is_taken_once(tmp_path: Path) -> None:
    color, depth = [0.0, 0.033, 0.066, 0.100], [0.004, 0.030, 0.031, 0.085, 0.119]
    for name, stamps in (("rgb.txt", color), ("depth.txt", depth)):
        (tmp_path / name).write_text("".join(f"{t:.3f} {t:.3f}.dat\n" for t in stamps))
        for t in stamps:
            (tmp_path / f"{t:.3f}.dat").write_bytes(b"anything")
    (tmp_path / "done").touch()
    layout, pairs = rgbd_layout(CAMERA), []

    def view(first: Entry, second: Entry) -> View:
        pairs.append((first.t, second.t))
        return View(first.t, "", "", np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32))

    list(
        Followed(
            tmp_path,
            CAMERA,
            type(layout)(layout.first, layout.second, layout.max_difference, view),
            1,
        )
    )
    assert pairs == [(0.0, 0.004), (0.033, 0.031), (0.066, 0.085), (0.1, 0.119)]


def frames(count: int) -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float32], float]]:
    for index, T_wc in enumerate(camera_path(count)):
        rgb, depth, _ = render(room(), T_wc)
        depth[:5] = np.nan
        yield rgb, depth, index / 30


def test_a_camera_of_ones_own(tmp_path: Path) -> None:
    seen = []
    metrics = run_source(
        Live(CAMERA, frames(FRAMES)),
        out=tmp_path / "run",
        features=400,
        observers=[
            lambda view, mask, record, tracker: seen.append((view.t, record.pose.tracked, mask))
        ],
    )
    assert metrics["coverage"] == 1.0
    assert [row[0] for row in seen] == [index / 30 for index in range(FRAMES)]
    assert all(tracked and mask is None for _, tracked, mask in seen)
    assert (tmp_path / "run" / "trajectory.txt").read_text().count("\n") == FRAMES + 1


class RealSense(ModuleType):
    """What docs/how-to/live-camera.md uses of pyrealsense2, with a camera that ends after some frames."""

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

    def _next(
        self, coming: Iterator[tuple[NDArray[np.uint8], NDArray[np.float32], float]]
    ) -> SimpleNamespace:
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


def test_the_example_of_the_documentation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(__file__).parents[3] / "docs" / "how-to" / "live-camera.md").read_text(
        encoding="utf-8"
    )
    (example,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    monkeypatch.setitem(sys.modules, "pyrealsense2", RealSense())
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "docs/how-to/live-camera.md", "exec"), {})
    metrics = json.loads((tmp_path / "runs" / "realsense" / "metrics.json").read_text())
    assert (metrics["frames"], metrics["coverage"]) == (5, 1.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rgb, depth, t: (rgb[:-1], depth, t), "the camera is 320x240"),
        (lambda rgb, depth, t: (rgb.astype(np.float32), depth, t), "float32"),
        (lambda rgb, depth, t: (rgb, depth, 0.0), "does not come after"),
    ],
    ids=["size", "kind", "time"],
)
def test_a_camera_that_gives_something_else(tmp_path: Path, change: object, said: str) -> None:
    assert callable(change)
    altered = (change(*frame) for frame in frames(2))
    with pytest.raises(DataError, match=said):
        list(Live(CAMERA, altered))


def test_what_a_live_run_has_is_written_when_its_camera_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def failing() -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float32], float]]:
        yield from frames(4)
        raise DataError("the cable is out")

    assert run_source(Live(CAMERA, failing()), out=tmp_path / "run", features=400)["frames"] == 4
    assert "ended: the cable is out" in capsys.readouterr().err
    assert (tmp_path / "run" / "map.ply").exists()


def test_ctrl_c_ends_a_live_run_after_the_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, seen = signal.getsignal(signal.SIGINT), []

    def interrupt(view: View, mask: object, record: object, tracker: object) -> None:
        seen.append(view.t)
        if len(seen) == 3:
            signal.raise_signal(signal.SIGINT)

    metrics = run_source(
        Live(CAMERA, frames(1000)), out=tmp_path / "run", features=400, observers=[interrupt]
    )
    assert metrics["frames"] == len(seen) == 3
    assert "stopping; Ctrl-C again" in capsys.readouterr().err
    assert (tmp_path / "run" / "trajectory.txt").exists()
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_ends_the_wait_for_more(recorded: Path, tmp_path: Path) -> None:
    seen = []

    def interrupt_later(view: View, mask: object, record: object, tracker: object) -> None:
        seen.append(view.t)
        if len(seen) == FRAMES:
            threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()

    source = Followed(recorded, CAMERA, rgbd_layout(CAMERA), idle=600)
    metrics = run_source(source, out=tmp_path / "run", features=400, observers=[interrupt_later])
    assert metrics["frames"] == FRAMES
