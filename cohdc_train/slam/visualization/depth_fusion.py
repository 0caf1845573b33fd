"""The dense coloured cloud of what stands still: the keyframes' depth, joined by the poses the run
ends with.
"""

import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.drawing import encode_jpeg
from cohdc_train.slam.dynamics.masks import grow
from cohdc_train.slam.frame import FrameRecord, View
from cohdc_train.slam.geometry.camera import Camera, maps_onto
from cohdc_train.slam.geometry.se3 import Array, to_local
from cohdc_train.slam.tracking.tracker import Tracker
from cohdc_train.slam.visualization.point_cloud import Cloud
from cohdc_train.slam.visualization.voxel_grid import VoxelGrid

_EDGE = 0.04  # of the depth: a larger step within two pixels is an edge, where near and far mix
_MASK_BAND = (
    0.01  # of the image's width by which a mask grows once more: depth images smear outlines
)
_UNITS = 50_000.0  # per camera.far, in the file of kept depth images, which hold 1.3 of it
_NOISE = (
    0.03,
    0.01,
)  # m, and a Kinect's m / m^2: depth z is held to be within a + b z^2 of the surface it shows
_JPEG_QUALITY = 95  # of kept color images
_DOUBT = 2  # a view through a point outweighs so many that show it

Frame = tuple[float, NDArray[np.uint8], NDArray[np.float32]]


class KeyframeImages:
    """Watches a run; keeps colour and unmasked depth of its keyframes in a nameless file on disk,
    200 to 600 kB each.

    folder: where that file lies until the block it is opened in ends.
    """

    def __init__(self, camera: Camera, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by __exit__
        self._index: list[tuple[float, int, int]] = []  # t, bytes of colour, bytes of depth
        self._maps = maps_onto(camera, camera) if camera.distortion.any() else None
        self._units = _UNITS / camera.far  # per m

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __call__(
        self, view: View, mask: NDArray[np.bool_] | None, record: FrameRecord, tracker: Tracker
    ) -> None:
        """Keep the frame when it became a keyframe."""
        if not record.pose.keyframe:
            return
        rgb, depth = view.rgb, np.minimum(unmasked(view.depth, mask), 65_535 / self._units)
        if self._maps is not None:
            rgb = cv2.remap(rgb, *self._maps, cv2.INTER_LINEAR).astype(np.uint8)
            depth = cv2.remap(depth, *self._maps, cv2.INTER_NEAREST).astype(np.float32)
        jpeg = encode_jpeg(rgb, _JPEG_QUALITY)
        units = np.rint(depth * self._units).astype(np.uint16)
        png = cv2.imencode(".png", units, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        self._file.write(jpeg + png)
        self._index.append((view.t, len(jpeg), len(png)))

    def __iter__(self) -> Iterator[Frame]:
        """(t s, colour [H, W, 3] RGB, unmasked depth [H, W] m, 0 = none) of every keyframe, without
        distortion.
        """
        self._file.seek(0)
        for t, color, depth in self._index:
            jpeg, png = (np.frombuffer(self._file.read(size), np.uint8) for size in (color, depth))
            bgr = np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), np.uint8)
            yield (
                t,
                bgr[..., ::-1],
                np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED), np.float32)
                / np.float32(self._units),
            )


def unmasked(depth: NDArray[np.float32], mask: NDArray[np.bool_] | None) -> NDArray[np.float32]:
    """[H, W] m, 0 = none: depth without what lies under the mask, which is grown once more."""
    if mask is None:
        return depth
    return np.where(grow(mask, _MASK_BAND * mask.shape[1]), 0, depth).astype(np.float32)


def sure(depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    """[H, W] m, 0 = none: depth without readings beside a depth edge or beyond the sensor's good
    range.
    """
    kernel = np.ones((5, 5), dtype=np.uint8)
    step = cv2.dilate(depth, kernel) - _nearest(depth, kernel)
    allowed = _EDGE * depth
    if camera.baseline:
        allowed = np.maximum(allowed, 2 * _spread(camera) * depth**2)
    return np.where((depth <= camera.far) & (step <= allowed), depth, 0).astype(np.float32)


def _spread(camera: Camera) -> float:
    """m / m^2 by which depth errs with its square: a Kinect's, or one px of a stereo pair's
    disparity.
    """
    return 1 / (camera.fx * camera.baseline) if camera.baseline else _NOISE[1]


def _nearest(depth: NDArray[np.float32], kernel: NDArray[np.uint8]) -> NDArray[np.float32]:
    """[H, W] m: the smallest reading around every pixel, infinite where there is none."""
    return np.asarray(
        cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), kernel), np.float32
    )


def fuse(images: Iterable[Frame], poses: dict[float, Array], camera: Camera, voxel: float) -> Cloud:
    """One point per cube of `voxel` m that at least two keyframes saw and that the others do not
    see through.

    images: gone through twice; poses: t -> T_cw [4, 4] of frames, m; images without a pose are left
    out.
    """
    grid = VoxelGrid(voxel)
    rays = _rays(camera)
    count = 0
    for t, rgb, depth in images:
        if t in poses:
            depth = sure(depth, camera)
            seen = depth > 0
            local = rays[seen] * depth[seen][:, None]
            grid.add((local - poses[t][:3, 3]) @ poses[t][:3, :3], rgb[seen], count)
            count += 1
    points, colors = grid.cells(min(count, 2))
    balance = np.zeros(len(points), dtype=np.int32)
    for t, _, depth in images:
        if t in poses:
            balance += _evidence(points, depth, poses[t], camera)
    return Cloud(points[balance > 0], colors[balance > 0])


def _rays(camera: Camera) -> Array:
    """[H, W, 3]: every pixel's direction, 1 m along the optical axis."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    return camera.backproject(pixels, np.ones(u.size)).reshape(*u.shape, 3)


def _evidence(
    points: Array, depth: NDArray[np.float32], T_cw: Array, camera: Camera
) -> NDArray[np.int32]:
    """[n] what one keyframe says of every point: 1 = there it is, -2 = the view goes through it, 0
    = nothing.

    A view goes through when all readings within a pixel lie behind the point.
    """
    local = to_local(T_cw, points)
    z = local[:, 2]
    verdict = np.zeros(len(points), dtype=np.int32)
    ahead = np.flatnonzero(z > 0.1)
    columns, rows = np.rint(camera.project(local[ahead])).astype(np.int64).T
    inside = (columns >= 0) & (rows >= 0) & (columns < camera.width) & (rows < camera.height)
    ahead, columns, rows = ahead[inside], columns[inside], rows[inside]
    nearest = _nearest(depth, np.ones((3, 3), dtype=np.uint8))[rows, columns]
    behind, margin = depth[rows, columns] - z[ahead], _NOISE[0] + _spread(camera) * z[ahead] ** 2
    reading = depth[rows, columns] > 0
    verdict[ahead[reading & (np.abs(behind) <= margin)]] = 1
    verdict[ahead[reading & (nearest > z[ahead] + margin)]] = -_DOUBT
    return verdict
