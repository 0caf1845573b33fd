"""Rendered world for tests: textured rectangles with exact color and depth."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import SlamConfig
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.frame import FrameResult, PoseCallback, RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import exp_se3
from cohdc_train.slam.system import Slam
from cohdc_train.trajectory.trajectory import Trajectory

CAMERA = Camera(fx=260.0, fy=260.0, cx=159.5, cy=119.5, width=320, height=240, depth_scale=5000.0)
CAMERA_YAML = "fx: 260\nfy: 260\ncx: 159.5\ncy: 119.5\nwidth: 320\nheight: 240\ndepth_scale: 5000\n"


@dataclass(frozen=True)
class Rectangle:
    """Textured rectangle in space.

    origin: [3] m, a corner; across, down: [3] m, the edges from there; texture: [h, w, 3] uint8;
    moving: part of the mask.
    """

    origin: NDArray[np.float64]
    across: NDArray[np.float64]
    down: NDArray[np.float64]
    texture: NDArray[np.uint8]
    moving: bool = False


def texture(
    rng: np.random.Generator, height: int, width: int, patches: int = 900
) -> NDArray[np.uint8]:
    """Draw overlapping patches of random color, with distinctive keypoints everywhere."""
    image = np.full((height, width, 3), 120, dtype=np.uint8)
    for _ in range(patches):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        w, h = (int(v) for v in rng.integers(6, 40, size=2))
        color = tuple(int(v) for v in rng.integers(0, 256, size=3))
        cv2.rectangle(image, (x, y), (x + w, y + h), color, -1)
    return cv2.GaussianBlur(image, (3, 3), 0)


@cache
def room(seed: int = 0) -> list[Rectangle]:
    """Return a wall at 2.6 m, a floor, and a box in front of them."""
    rng = np.random.default_rng(seed)
    return [
        Rectangle(
            np.array([-3.0, -2.0, 2.6]),
            np.array([6.0, 0, 0]),
            np.array([0, 3.0, 0]),
            texture(rng, 600, 1200),
        ),
        Rectangle(
            np.array([-3.0, 1.0, 0.5]),
            np.array([6.0, 0, 0]),
            np.array([0, 0, 2.1]),
            texture(rng, 420, 1200),
        ),
        Rectangle(
            np.array([0.2, -0.1, 1.9]),
            np.array([0.7, 0, 0.1]),
            np.array([0, 0.8, 0]),
            texture(rng, 240, 200),
        ),
    ]


def passer_by(step: float, seed: int = 7) -> Rectangle:
    """Return a textured board that moves with `step` in front of the camera.

    It has many keypoints, the worst case of a moving object.
    """
    left = -1.0 + 0.03 * step
    return Rectangle(
        np.array([left, -0.7, 1.6]),
        np.array([0.65, 0, 0]),
        np.array([0, 1.4, 0]),
        _board(seed),
        moving=True,
    )


@cache
def _board(seed: int) -> NDArray[np.uint8]:
    return texture(np.random.default_rng(seed), 300, 140, patches=400)


def camera_path(frames: int, later: float = 0.0) -> NDArray[np.float64]:
    """Return poses [frames, 4, 4] T_wc of a camera that sways by about 25 cm and 5 degrees."""
    s = (np.arange(frames) + later) / 60.0 * 2 * np.pi
    xi = np.stack([0.25 * np.sin(s), 0.1 * np.sin(2 * s), 0.12 * (1 - np.cos(s))], axis=1)
    turn = np.stack([0.04 * np.sin(s), 0.08 * (1 - np.cos(s)), 0.05 * np.sin(2 * s)], axis=1)
    return exp_se3(np.concatenate([xi, turn], axis=1))


@cache
def _rays(camera: Camera) -> NDArray[np.float64]:
    """Return the ray [H, W, 3] of each pixel, of depth 1."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1
    )


def _covered_part(
    origin: NDArray[np.float64],
    across: NDArray[np.float64],
    down: NDArray[np.float64],
    camera: Camera,
) -> tuple[slice, slice]:
    """Return the rows and columns that a rectangle can cover; all where it reaches back."""
    x, y, z = np.stack([origin, origin + across, origin + down, origin + across + down], axis=1)
    if z.max() <= 0.1:
        return slice(0, 0), slice(0, 0)
    if z.min() <= 0.1:
        return slice(0, camera.height), slice(0, camera.width)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return _pixels(v, camera.height), _pixels(u, camera.width)


def _pixels(positions: NDArray[np.float64], size: int) -> slice:
    """Return the pixels between the first and the last position that lie in an image."""
    first, last = np.floor(positions.min()), np.ceil(positions.max())
    return slice(int(np.clip(first, 0, size)), int(np.clip(last + 1, 0, size)))


def render(
    rectangles: list[Rectangle], T_wc: NDArray[np.float64], camera: Camera = CAMERA
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_]]:
    """Render rectangles into a camera.

    Returns color [H, W, 3], depth [H, W] m with 0 where nothing is hit, and the mask [H, W] of
    moving rectangles.
    """
    T_cw = np.linalg.inv(T_wc)
    rgb = np.full((camera.height, camera.width, 3), 90, dtype=np.uint8)
    nearest = np.full((camera.height, camera.width), np.inf)
    moving = np.zeros((camera.height, camera.width), dtype=np.bool_)
    whole_image = _rays(camera)
    for item in rectangles:
        origin = T_cw[:3, :3] @ item.origin + T_cw[:3, 3]
        across, down = T_cw[:3, :3] @ item.across, T_cw[:3, :3] @ item.down
        part = _covered_part(origin, across, down, camera)
        rays = whole_image[part]
        if rays.size == 0:
            continue
        normal = np.cross(across, down)
        depth = (normal @ origin) / (rays @ normal)
        local = rays * depth[..., None] - origin
        a, b = local @ across / (across @ across), local @ down / (down @ down)
        height, width = item.texture.shape[:2]
        map_u, map_v = (a * width - 0.5).astype(np.float32), (b * height - 0.5).astype(np.float32)
        seen = (a >= 0) & (a < 1) & (b >= 0) & (b < 1) & (depth > 0.1) & (depth < nearest[part])
        sampled = cv2.remap(
            item.texture, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        rgb[part][seen], nearest[part][seen] = sampled[seen], depth[seen]
        moving[part][seen] = item.moving
    return rgb, np.where(np.isfinite(nearest), nearest, 0).astype(np.float32), moving


def slam_config(max_keypoints: int, **options: object) -> SlamConfig:
    """Return options with few keypoints; two underscores replace a period: loops__enabled=False."""
    dotted = {name.replace("__", "."): value for name, value in options.items()}
    return SlamConfig().override({"features.max_keypoints": max_keypoints, **dotted})


def track(
    slam: Slam,
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    timestamp: float,
    mask: NDArray[np.bool_] | None = None,
    depth_timestamp: float | None = None,
    on_pose: PoseCallback | None = None,
) -> FrameResult:
    """Track a frame given as arrays."""
    return slam.track(RGBDFrame(timestamp, rgb, depth, depth_timestamp), mask, on_pose)


def features_at(pixels: NDArray[np.float64], depths: NDArray[np.float64]) -> Features:
    """Return features of the finest level at undistorted pixels [n, 2] px with depths [n] m.

    All descriptors are zero.
    """
    none = np.zeros(len(pixels), dtype=np.int64)
    return Features(
        pixels, pixels, none, np.zeros((len(pixels), 4), dtype=np.uint64), depths, none > 0
    )


def write_sequence(folder: Path, frames: int, with_passer_by: bool = False) -> Path:
    """Write a TUM folder of the room with masks/, camera.yaml, and groundtruth.txt.

    It has 30 frames/s, with depth 5 ms after color.
    """
    for name in ("rgb", "depth", "masks"):
        (folder / name).mkdir(parents=True)
    rows: dict[str, list[str]] = {"rgb": [], "depth": []}
    poses, delay = camera_path(frames), 0.005 * 30
    for index, (pose, late) in enumerate(zip(poses, camera_path(frames, delay), strict=True)):
        boards = [(passer_by(index), passer_by(index + delay))] if with_passer_by else []
        rgb, _, moving = render([*room(), *(now for now, _ in boards)], pose)
        depth = render([*room(), *(then for _, then in boards)], late)[1]
        stamp, later = f"{100 + index / 30:.6f}", f"{100.005 + index / 30:.6f}"
        cv2.imwrite(str(folder / "rgb" / f"{stamp}.png"), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        cv2.imwrite(
            str(folder / "depth" / f"{later}.png"), (depth * 5000).round().astype(np.uint16)
        )
        cv2.imwrite(str(folder / "masks" / f"{stamp}.png"), moving.astype(np.uint8) * 255)
        rows["rgb"].append(f"{stamp} rgb/{stamp}.png")
        rows["depth"].append(f"{later} depth/{later}.png")
    for name, lines in rows.items():
        (folder / f"{name}.txt").write_text("# stamp file\n" + "\n".join(lines) + "\n")
    (folder / "camera.yaml").write_text(CAMERA_YAML)
    stamps = np.array([float(line.split()[0]) for line in rows["rgb"]])
    Trajectory(stamps, poses).save_tum(folder / "groundtruth.txt")
    return folder
