"""Inputs of the golden cases: rendered or trained once with BASE, or cut from the shared data."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from golden_checkout import Checkout
from numpy.typing import NDArray

Image = NDArray[np.uint8]

_STEREO_BASELINE = 0.12  # m
_DEPTH_SCALE = 5000  # units per m of the rendered depth images
_UNKNOWN_DEPTH = 5.0  # m, where a rendered depth image has no value
_XYZ = "rgbd_dataset_freiburg1_xyz"

# All options of `cohdc fit` that are used, in one place: a tiny network on one thread in float32.
_FIT_OPTIONS = {
    "pretrained": "none",
    "pictures": "false",
    "data.canvas": "[96,128]",
    "data.batch_size": "2",
    "data.workers": "0",
    "model.network.depth": "18",
    "model.network.width": "0.25",
    "model.network.fpn_channels": "16",
    "model.network.fc": "32",
    "model.network.anchor_scales": "[16,32,64,128]",
    "model.network.proposals": "[100,50]",
    "model.network.rois": "32",
    "model.network.detections": "10",
    "trainer.accelerator": "cpu",
    "trainer.precision": "32-true",
    "trainer.enable_progress_bar": "false",
    "trainer.log_every_n_steps": "1",
}


def fit_command(data: Path, out: str, steps: int) -> list[str]:
    """Return the command of a training of so many steps with seed 0."""
    options = {"seed_everything": "0", "trainer.max_steps": str(steps)} | _FIT_OPTIONS
    words = [f"--{name}={value}" for name, value in options.items()]
    return ["cohdc", "fit", str(data), f"--out={out}", *words]


class Inputs:
    """Folders and files that both checkouts read; each is made when it is first asked for."""

    def __init__(self, folder: Path, base: Checkout, shared: Path) -> None:
        self.shared = shared
        self._folder = folder
        self._base = base

    def nothing(self) -> Path:
        """Return an empty folder, for cases that need no input."""
        return self._once("nothing", lambda out: out.mkdir())

    def xyz(self) -> Path:
        """Cut the first 300 frames out of freiburg1_xyz."""
        return self._once(_XYZ, lambda out: _cut_sequence(self.shared / "data/tum" / _XYZ, out))

    def loop(self) -> Path:
        """Render a way around a room."""
        return self._render("loop", "--motion=loop --frames=300 --people=0 --size=[120,160]")

    def walk(self) -> Path:
        """Render people who walk, with their masks."""
        return self._render("walk", "--motion=xyz --frames=90 --people=2 --size=[144,192]")

    def still(self) -> Path:
        """Render an empty room."""
        return self._render("still", "--motion=halfsphere --frames=40 --people=0 --size=[240,320]")

    def stereo(self) -> Path:
        """Turn the empty room into a rectified stereo pair."""
        still = self.still()
        return self._once("stereo", lambda out: _make_stereo(still, out))

    def people(self) -> Path:
        """Render a COCO-format folder."""
        words = ["--train", "20", "--val", "6", "--size", "[96,128]"]
        command = ["cohdc", "synth", "coco", "people", *words]
        return self._once("people", lambda out: self._base.run(command, out.parent))

    def checkpoint(self) -> Path:
        """Train a tiny network for one step, and scale its last layers so that it finds objects."""
        command = fit_command(self.people(), "fit", steps=1)
        folder = self._once("fit", lambda out: self._base.run(command, out.parent))
        return self._once("scaled.ckpt", lambda out: _scale_weights(folder / "last.ckpt", out))

    def photos(self) -> Path:
        """Link three photos of every folder of samples."""
        return self._once("photos", lambda out: _link_photos(self.shared / "data/samples", out))

    def scored(self) -> Path:
        """Cut ten validation images out of coco_small, beside links to the trajectories."""
        return self._once("scored", lambda out: _collect_scored(self.shared / "data", out))

    def _render(self, name: str, options: str) -> Path:
        command = ["cohdc", "synth", "sequence", name, *options.split()]
        return self._once(name, lambda out: self._base.run(command, out.parent))

    def _once(self, name: str, make: Callable[[Path], object]) -> Path:
        path = self._folder / name
        if not path.exists():
            make(path)
        return path


def _cut_sequence(sequence: Path, out: Path, num_frames: int = 300) -> None:
    out.mkdir()
    for name in ("rgb", "depth", "groundtruth.txt"):
        (out / name).symlink_to((sequence / name).resolve())
    for name in ("rgb.txt", "depth.txt"):
        lines = (sequence / name).read_text().splitlines()
        images = [line for line in lines if not line.startswith("#")]
        (out / name).write_text("\n".join(images[:num_frames]) + "\n")


def _collect_scored(data: Path, out: Path) -> None:
    out.mkdir()
    for name in ("trajectories", "groundtruth"):
        (out / name).symlink_to((data / "tum" / name).resolve())
    _cut_coco(data / "coco_small", out / "coco")


def _cut_coco(folder: Path, out: Path, num_images: int = 10) -> None:
    out.mkdir()
    (out / "images").symlink_to((folder / "images").resolve())
    for name in ("instances_train.json", "instances_val.json"):
        content = json.loads((folder / name).read_text())
        content["images"] = content["images"][:num_images]
        kept = {image["id"] for image in content["images"]}
        annotations = content["annotations"]
        content["annotations"] = [entry for entry in annotations if entry["image_id"] in kept]
        (out / name).write_text(json.dumps(content))


def _link_photos(samples: Path, out: Path, num_photos: int = 3) -> None:
    out.mkdir()
    for folder in sorted(samples.iterdir()):
        for photo in sorted(folder.iterdir())[:num_photos]:
            (out / photo.name).symlink_to(photo.resolve())


def _scale_weights(checkpoint: Path, out: Path) -> None:
    """Scale as tests/conftest.py does: boxes and masks differ from place to place."""
    import torch

    content = torch.load(checkpoint, map_location="cpu", weights_only=True)
    weights = content["state_dict"]
    weights["network.rpn.head.cls_logits.weight"] *= 3
    weights["network.rpn.head.bbox_pred.weight"] *= 10
    weights["network.roi_heads.mask_predictor.mask_fcn_logits.weight"] *= 5
    torch.save(content, out)


def _make_stereo(sequence: Path, out: Path) -> None:
    out.mkdir()
    camera = (sequence / "camera.yaml").read_text().splitlines()
    values = dict(line.split(": ") for line in camera)
    values["fy"] = values["fx"]  # a rectified pair has one focal length
    del values["depth_scale"]
    values["baseline"] = str(_STEREO_BASELINE)
    (out / "camera.yaml").write_text("".join(f"{key}: {text}\n" for key, text in values.items()))
    (out / "left").symlink_to((sequence / "rgb").resolve())
    (out / "right").mkdir()
    (out / "groundtruth.txt").symlink_to((sequence / "groundtruth.txt").resolve())
    lists = (sequence / "rgb.txt").read_text()
    for side in ("left", "right"):
        (out / f"{side}.txt").write_text(lists.replace("rgb/", f"{side}/"))
    for path in sorted((sequence / "rgb").iterdir()):
        left = np.asarray(cv2.imread(str(path)), dtype=np.uint8)
        depth = cv2.imread(str(sequence / "depth" / path.name), cv2.IMREAD_UNCHANGED)
        right = right_view(left, np.asarray(depth) / _DEPTH_SCALE, float(values["fx"]))
        cv2.imwrite(str(out / "right" / path.name), right)


def right_view(left: Image, depth: NDArray[np.floating], fx: float) -> Image:
    """Move every pixel to where the right camera sees it.

    left: (H, W, 3); depth: (H, W) m, 0 = unknown; fx: px. Returns (H, W, 3).
    """
    finer = 4  # columns per pixel, so that disparities are no whole pixels
    height, width = depth.shape
    size = (width * finer, height)
    colors = cv2.resize(left, size, interpolation=cv2.INTER_LINEAR)
    known = np.where(depth > 0, depth, _UNKNOWN_DEPTH)
    meters = cv2.resize(known, size, interpolation=cv2.INTER_NEAREST)
    columns = np.arange(size[0]) - finer * fx * _STEREO_BASELINE / meters
    columns = np.clip(np.rint(columns), 0, size[0] - 1).astype(int)
    right = colors.copy()  # what the left camera does not see keeps its color
    for row in range(height):
        order = np.argsort(-meters[row], kind="stable")  # the nearest is drawn last
        right[row, columns[row, order]] = colors[row, order]
    return np.asarray(cv2.resize(right, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
