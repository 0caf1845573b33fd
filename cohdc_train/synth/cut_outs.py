"""People cut out of photographs, seen by a moving RGB-D camera."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.synth.sensor import EDGE_DROPOUT, depth_edges
from cohdc_train.types import Float32Array, FloatArray, Image, Mask

if TYPE_CHECKING:  # loaded when the command runs, so that help stays cheap
    from cohdc_train.slam.geometry.camera import Camera
    from cohdc_train.slam.io.tum import TimestampedImage

BODY_WIDTH_M, MAX_HEIGHT_M = 0.6, 1.8  # shoulders with arms, and the tallest person
HEAD_HEIGHT_M = 1.75  # top of the head above the floor
RELIEF_M = 0.12  # bulge at the middle of a body
UP = np.array([0.0, 0.0, 1.0])  # of TUM's motion capture
_MIN_DEPTH_M = 0.3


@dataclass(frozen=True)
class CutOut:
    """A photographed person on an upright plane.

    Attributes:
        layers: float32 [h, w, 5]: red, green, blue 0..255, opacity 0..1, relief in m.
        width: m.
        height: m.
    """

    layers: Float32Array
    width: float
    height: float

    @classmethod
    def from_photo(cls, rgb: Image, mask: Mask) -> "CutOut":
        """Cut a person out of a photograph. rgb: [H, W, 3]; mask: [H, W]."""
        rows, columns = np.nonzero(mask)
        window = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
        rgb = np.pad(rgb[window], ((1, 1), (1, 1), (0, 0)))
        mask = np.pad(mask[window], 1)
        inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        relief = RELIEF_M * np.sqrt(np.clip(inside / inside.max(), 0, 1))
        layers = np.dstack([rgb, mask, relief]).astype(np.float32)
        num_rows, num_columns = mask.shape
        height = min(MAX_HEIGHT_M, BODY_WIDTH_M * num_rows / num_columns)
        return cls(layers, height * num_columns / num_rows, height)


@dataclass(frozen=True)
class WalkPath:
    """A walk back and forth across the view, in the world frame.

    Attributes:
        middle: [3], m, on the floor.
        along: [3] unit vector of the walk.
        facing: [3] unit normal of the person's plane.
        amplitude: m.
        period: s.
        phase: rad.
    """

    middle: FloatArray
    along: FloatArray
    facing: FloatArray
    amplitude: float
    period: float
    phase: float

    def position(self, time: float) -> FloatArray:
        """Return the point on the floor at a time in s: [3], m."""
        angle = 2 * np.pi * time / self.period + self.phase
        return np.asarray(self.middle + self.along * self.amplitude * np.sin(angle))


def pixel_rays(camera: "Camera", step: int) -> FloatArray:
    """Return the direction of every step-th pixel with z = 1, undistorted: [H/step, W/step, 3]."""
    x, y = np.meshgrid(np.arange(0, camera.width, step), np.arange(0, camera.height, step))
    pixels = camera.undistort(np.stack([x.ravel(), y.ravel()], 1).astype(float))
    directions = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    rays = np.concatenate([directions, np.ones((len(pixels), 1))], 1)
    return rays.reshape(*x.shape, 3)


def render(
    person: CutOut, path: WalkPath, time: float, T_wc: FloatArray, rays: FloatArray
) -> tuple[Float32Array, FloatArray]:
    """Render a person as a camera sees it.

    Args:
        person: the cut-out.
        path: where it walks.
        time: s.
        T_wc: [4, 4] camera to world, m.
        rays: [H, W, 3] of `pixel_rays`.

    Returns:
        Layers [H, W, 5], and depth [H, W] in m, infinite where nothing of the person is seen.
    """
    floor, eye = path.position(time), T_wc[:3, 3]
    world = rays @ T_wc[:3, :3].T
    approach = world @ path.facing
    approach = np.where(np.abs(approach) < 1e-6, 1e-6, approach)
    depth = ((floor - eye) @ path.facing) / approach
    hit = eye + depth[..., None] * world - floor

    num_rows, num_columns = person.layers.shape[:2]
    u = ((hit @ path.along) / person.width + 0.5) * num_columns - 0.5
    v = (HEAD_HEIGHT_M - hit @ UP) / person.height * num_rows - 0.5
    u, v = u.astype(np.float32), v.astype(np.float32)
    layers = np.asarray(cv2.remap(person.layers, u, v, cv2.INTER_LINEAR, borderValue=0), np.float32)
    is_seen = (layers[..., 3] > 0) & (depth > _MIN_DEPTH_M)
    return layers, np.where(is_seen, depth - layers[..., 4], np.inf)


def fill_depth(depth: Float32Array) -> Float32Array:
    """Fill holes with the farthest depth around them; infinite where there is none.

    depth: [H, W], m, 0 = no reading.
    """
    filled = np.where(depth > 0, depth, cv2.dilate(depth, np.ones((9, 9), np.uint8)))
    return np.where(filled > 0, filled, np.inf).astype(np.float32)


def compose_frame(
    pair: "tuple[TimestampedImage, TimestampedImage]",
    camera: "Camera",
    layers: Sequence[tuple[Float32Array, FloatArray]],
    rng: np.random.Generator,
) -> tuple[Image, NDArray[np.uint16], Mask]:
    """Draw people into a frame, the nearest over the others.

    Args:
        pair: the color and the depth image.
        camera: the sequence's camera.
        layers: of `render`, one per person.
        rng: random generator of the sensor's noise.

    Returns:
        rgb [H, W, 3], depth [H, W] in the camera's units, and the mask of the people [H, W].
    """
    from cohdc_train.slam.io.tum import read_depth, read_rgb

    color, depth_image = pair
    rgb = read_rgb(color.path, camera).astype(np.float32)
    depth = read_depth(depth_image.path, camera)
    nearest: NDArray[np.floating] = fill_depth(depth)
    mask = np.zeros(depth.shape, np.bool_)
    brightness = rgb.mean()
    for person, z in sorted(layers, key=lambda layer: -float(np.min(layer[1]))):
        inside = person[..., 3] > 0.5
        if not inside.any():
            continue
        opacity = np.where(z < nearest, person[..., 3], 0)[..., None]
        mean = max(float(person[inside][:, :3].mean()), 1.0)
        gain = np.clip(brightness / mean, 0.7, 1.4)
        rgb = (1 - opacity) * rgb + opacity * np.clip(person[..., :3] * gain, 0, 255)
        is_person = opacity[..., 0] > 0.5
        nearest, mask = np.where(is_person, z, nearest), mask | is_person
    depth = _measure_depth(depth, nearest, mask, rng)
    units = np.rint(depth * camera.depth_scale).astype(np.uint16)
    return np.rint(rgb).astype(np.uint8), units, mask


def _measure_depth(
    depth: Float32Array, nearest: NDArray[np.floating], mask: Mask, rng: np.random.Generator
) -> Float32Array:
    """Measure the people with the sensor's noise, and drop readings at their outlines."""
    z = np.where(np.isfinite(nearest), nearest, 0).astype(np.float32)
    sigma = 0.0012 + 0.0019 * np.square(z - 0.4)
    noisy = z + sigma * rng.standard_normal(z.shape, dtype=np.float32)
    is_dropped = depth_edges(z) & (rng.random(z.shape) < EDGE_DROPOUT)
    around = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    measured = np.where(mask, noisy, depth)
    return np.where(around & is_dropped, np.float32(0), measured)
