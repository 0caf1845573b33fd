"""Small run folders that tests of the report read, written as the verbs write them."""

import csv
import json
from collections.abc import Collection, Mapping
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import yaml

from cohdc_train.slam.io.ply import write_ply
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

FRAMES = 60
START = 100.0
RATE = 30
COLUMNS = ("stamp", "tracked", "keyframe", "inliers", "culled_share")
TIMES = ("segment_ms", "track_ms", "map_ms")


class Page(HTMLParser):
    """What a page shows and what it would have to fetch. Raises AssertionError for bad nesting."""

    VOID = ("meta", "img")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.images: list[str] = []
        self.cells: list[str] = []
        self.heads: list[str] = []
        self.facts: dict[str, str] = {}
        self.captions: list[str] = []
        self.text = ""
        self.open: list[str] = []
        self.tags: set[str] = set()
        self._fact = ""
        self.feed(text)
        self.close()
        assert self.open == [], f"{self.open} are not closed"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        fields = dict(attrs)
        assert tag not in ("link", "iframe"), "the page must need nothing beside itself"
        assert "src" not in fields or (fields["src"] or "").startswith("data:image/")
        self.tags.add(tag)
        if tag == "img":
            self.images.append(fields["src"] or "")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> closes something else"

    def handle_data(self, data: str) -> None:
        where = self.open[-1] if self.open else ""
        if where in ("style", "script") or not data.strip():
            return
        self.text += data
        if where == "td":
            self.cells.append(data)
        elif where in ("h2", "h3"):
            self.heads.append(data)
        elif where == "dt":
            self._fact = data
        elif where == "dd":
            self.facts[self._fact] = data
        elif where == "strong":
            self.captions.append(data)


def trajectory(noise: float = 0.0, lost: Collection[int] = ()) -> Trajectory:
    """Return the trajectory of a camera on a helix, without the lost frames.

    noise: standard deviation of the positions, m.
    """
    time = np.arange(FRAMES) / RATE
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, 3] = np.stack([np.sin(time), np.cos(time), 0.3 * time], axis=1)
    poses[:, :3, 3] += noise * np.random.default_rng(1).normal(size=(FRAMES, 3))
    kept = np.array([k for k in range(FRAMES) if k not in lost])
    return Trajectory(START + time[kept], poses[kept])


def write_truth(folder: Path) -> Path:
    """Write groundtruth.txt into a folder of a sequence."""
    folder.mkdir(parents=True, exist_ok=True)
    trajectory().save_tum(folder / "groundtruth.txt")
    return folder / "groundtruth.txt"


def write_slam_run(
    folder: Path,
    noise: float = 0.001,
    lost: Collection[int] = (),
    sequence: Path | None = None,
    worst: Collection[int] = (),
    options: Mapping[str, object] | None = None,
) -> Path:
    """Write a folder as `cohdc slam` does. worst: indices of frames whose images are stored."""
    (folder / "pictures").mkdir(parents=True)
    estimate = trajectory(noise, lost)
    estimate.save_tum(folder / "trajectory.txt")
    metrics: dict[str, object] = {
        "seed": 3,
        "realtime": False,
        "loops": 1,
        "keyframes": 12,
        "keyframes_in_map": 10,
        "frames": FRAMES,
        "tracked": FRAMES - len(lost),
        "coverage": 1 - len(lost) / FRAMES,
        "fps": 21.5,
        "ms": {"track": {"p50": 11.25, "p95": 20.5}},
    }
    metrics |= score(trajectory(), estimate)
    (folder / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    camera = {"fx": 517.3, "fy": 516.5, "width": 640, "height": 480}
    config: dict[str, object] = {"model": "person.onnx", "seed": 3, "camera": camera}
    config |= {"sequence": str(sequence), "version": "0.1.0", **(options or {})}
    (folder / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    _write_frames(folder / "frames.csv", lost)
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -0.5, -1), (2, 2, 0), (400, 3))  # none above the cameras
    write_ply(folder / "map.ply", points, rng.integers(0, 256, (400, 3), np.uint8))
    for index in worst:
        image = np.full((48, 64, 3), 90, np.uint8)
        cv2.imwrite(str(folder / "pictures" / f"{START + index / RATE:.6f}_worst.jpg"), image)
    return folder


def _write_frames(file: Path, lost: Collection[int]) -> None:
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow([*COLUMNS, *TIMES])
        for k in range(FRAMES):
            tracked = k not in lost
            state = [
                int(tracked),
                int(k % 5 == 0),
                100 + k if tracked else 0,
                f"{0.01 * (k % 7):.4f}",
            ]
            writer.writerow([f"{START + k / RATE:.6f}", *state, "5.00", "12.00", "3.00"])


def write_training(folder: Path, classes: Collection[str] = ("car", "person")) -> Path:
    """Write a folder as `cohdc fit` does, of 40 steps with four validations."""
    (folder / "logs" / "version_0").mkdir(parents=True)
    (folder / "pictures").mkdir()
    config = {
        "seed_everything": 7,
        "pretrained": "auto",
        "data": {"root": "sets/street", "canvas": [240, 320], "batch_size": 2},
        "model": {"network": {"backbone": "hdc"}, "optimizer": {"lr": 0.001}},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    rows = []
    for step in range(4, 40, 5):
        loss = {"train/loss": 2 - step / 40, "train/mask": 1 - step / 80}
        rows.append({"epoch": step // 10, "step": step, "lr/heads": 0.001, **loss})
    for step, ap in ((9, 0.1), (19, 0.2), (29, 0.4), (39, 0.3)):
        scores = {"val/segm_AP": ap, "val/segm_AP50": 2 * ap, "val/boundary_AP": ap / 2}
        scores |= {f"val/segm_AP/{name}": ap + 0.01 * k for k, name in enumerate(classes)}
        rows.append({"epoch": step // 10, "step": step, **scores})
    write_log(folder / "logs" / "version_0" / "metrics.csv", rows)
    cv2.imwrite(str(folder / "pictures" / "worst.jpg"), np.full((300, 1600, 3), 90, np.uint8))
    return folder


def write_log(file: Path, rows: Collection[Mapping[str, object]]) -> None:
    """Write rows as Lightning's CSVLogger does: an empty cell for what a row has not."""
    file.parent.mkdir(parents=True, exist_ok=True)
    names = sorted({name for row in rows for name in row})
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, names, restval="")
        writer.writeheader()
        writer.writerows(rows)
