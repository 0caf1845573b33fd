"""Dense colored cloud of static surfaces: depth of the keyframes, fused at their final poses."""

import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.drawing import encode_jpeg
from cohdc_train.slam.config import DenseCloudConfig
from cohdc_train.slam.dynamics.masks import dilate_mask
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.geometry.camera import Camera, undistortion_maps
from cohdc_train.slam.geometry.se3 import Array, to_local
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.visualization.point_cloud import PointCloud
from cohdc_train.slam.visualization.voxel_grid import VoxelGrid

_MIN_Z_M = 0.1  # of a point that is compared with an image
_DEPTH_UNITS = 50_000.0  # of a stored depth image, up to the largest usable depth; 1.3 of it fit
_JPEG_QUALITY = 95
_PNG_COMPRESSION = [cv2.IMWRITE_PNG_COMPRESSION, 1]


class KeyframeImage(NamedTuple):
    """Undistorted images of a keyframe.

    Attributes:
        timestamp: s.
        rgb: [H, W, 3] uint8.
        depth: [H, W] m, 0 = no reading or dynamic.
    """

    timestamp: float
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]


class _StoredImage(NamedTuple):
    """Place of a keyframe in the file: bytes of its color image, then of its depth image."""

    timestamp: float
    color_bytes: int
    depth_bytes: int


class KeyframeImages:
    """Observer of a run that stores the images of keyframes on disk, 200 to 600 kB each.

    Iterate for KeyframeImage; more than once, if needed.
    """

    def __init__(
        self,
        camera: Camera,
        folder: Path,
        max_depth_m: float,
        config: DenseCloudConfig = DenseCloudConfig(),
    ) -> None:
        """Open an unnamed file, which is deleted when the `with` block ends.

        Args:
            camera: of the frames.
            folder: where the file lies.
            max_depth_m: largest depth that `fuse_depth_images` uses, m.
            config: dilation of masks.
        """
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by __exit__
        self._stored: list[_StoredImage] = []
        self._maps = undistortion_maps(camera, camera) if camera.distortion.any() else None
        self._units_per_m = _DEPTH_UNITS / max_depth_m
        self._config = config

    def __enter__(self) -> Self:
        """Return the store."""
        return self

    def __exit__(self, *_: object) -> None:
        """Delete the file."""
        self._file.close()

    def __call__(self, frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        """Store a frame that became a keyframe."""
        if not result.is_keyframe:
            return
        rgb = frame.rgb
        depth = remove_dynamic_depth(frame.depth, result.union_mask, self._config)
        depth = np.minimum(depth, 65_535 / self._units_per_m)
        if self._maps is not None:
            rgb = cv2.remap(rgb, *self._maps, cv2.INTER_LINEAR).astype(np.uint8)
            depth = cv2.remap(depth, *self._maps, cv2.INTER_NEAREST).astype(np.float32)
        units = np.rint(depth * self._units_per_m).astype(np.uint16)
        jpeg = encode_jpeg(rgb, _JPEG_QUALITY)
        png = cv2.imencode(".png", units, _PNG_COMPRESSION)[1].tobytes()
        self._file.write(jpeg + png)
        self._stored.append(_StoredImage(frame.timestamp, len(jpeg), len(png)))

    def __iter__(self) -> Iterator[KeyframeImage]:
        """Read the keyframes in the order in which they were stored."""
        self._file.seek(0)
        for timestamp, color_bytes, depth_bytes in self._stored:
            jpeg = np.frombuffer(self._file.read(color_bytes), np.uint8)
            png = np.frombuffer(self._file.read(depth_bytes), np.uint8)
            bgr = np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), np.uint8)
            units = np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED), np.float32)
            depth = units / np.float32(self._units_per_m)
            yield KeyframeImage(timestamp, bgr[..., ::-1], depth)


def remove_dynamic_depth(
    depth: NDArray[np.float32],
    mask: NDArray[np.bool_] | None,
    config: DenseCloudConfig = DenseCloudConfig(),
) -> NDArray[np.float32]:
    """Remove depth under a mask, which is dilated because depth images smear outlines.

    Args:
        depth: [H, W] m, 0 = no reading.
        mask: [H, W] bool, True = dynamic.
        config: dilation of the mask.

    Returns:
        [H, W] m.
    """
    if mask is None:
        return depth
    dilated = dilate_mask(mask, config.mask_margin_ratio * mask.shape[1])
    return np.where(dilated, 0, depth).astype(np.float32)


def filter_depth(
    depth: NDArray[np.float32],
    camera: Camera,
    max_depth_m: float,
    config: DenseCloudConfig = DenseCloudConfig(),
) -> NDArray[np.float32]:
    """Remove readings beside depth edges, where surfaces mix, and beyond the usable range.

    Args:
        depth: [H, W] m, 0 = no reading.
        camera: of the image.
        max_depth_m: end of the usable range, m.
        config: allowed depth steps.

    Returns:
        [H, W] m.
    """
    kernel = np.ones((5, 5), dtype=np.uint8)
    step = cv2.dilate(depth, kernel) - _nearest_reading(depth, kernel)
    allowed = config.max_depth_step_ratio * depth
    if camera.baseline:
        allowed = np.maximum(allowed, 2 * _noise_per_m(camera, config) * depth**2)
    return np.where((depth <= max_depth_m) & (step <= allowed), depth, 0).astype(np.float32)


def _noise_per_m(camera: Camera, config: DenseCloudConfig) -> float:
    """Return the factor b of the noise a + b z^2: of a stereo pair, 1 px of disparity; 1/m."""
    return 1 / (camera.fx * camera.baseline) if camera.baseline else config.depth_noise[1]


def _nearest_reading(depth: NDArray[np.float32], kernel: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the smallest reading around each pixel [H, W] m; infinite where there is none."""
    known = np.where(depth > 0, depth, np.inf).astype(np.float32)
    return np.asarray(cv2.erode(known, kernel), np.float32)


def fuse_depth_images(
    images: Iterable[KeyframeImage],
    poses: dict[float, Array],
    camera: Camera,
    max_depth_m: float,
    config: DenseCloudConfig = DenseCloudConfig(),
) -> PointCloud:
    """Fuse keyframes into one point per voxel that enough of them confirm.

    A voxel is confirmed where at least two keyframes have filled it, and the others do not see
    through it.

    Args:
        images: of keyframes; iterated twice.
        poses: timestamp to T_cw [4, 4], m; images without a pose are skipped.
        camera: of the images.
        max_depth_m: end of the usable depth range, m.
        config: voxels and noise.
    """
    grid = VoxelGrid(config.voxel_m, config.max_voxels)
    rays = _rays(camera)
    num_images = 0
    for timestamp, rgb, depth in images:
        if timestamp in poses:
            depth = filter_depth(depth, camera, max_depth_m, config)
            known = depth > 0
            local = rays[known] * depth[known][:, None]
            T_cw = poses[timestamp]
            grid.add((local - T_cw[:3, 3]) @ T_cw[:3, :3], rgb[known], num_images)
            num_images += 1

    points, colors = grid.cells(min(num_images, config.min_keyframes))
    votes = np.zeros(len(points), dtype=np.int32)
    for timestamp, _, depth in images:
        if timestamp in poses:
            votes += visibility_votes(points, depth, poses[timestamp], camera, config)
    return PointCloud(points[votes > 0], colors[votes > 0])


def _rays(camera: Camera) -> Array:
    """Return the direction of each pixel, 1 m along the optical axis: [H, W, 3]."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
    return camera.backproject(pixels, np.ones(u.size)).reshape(*u.shape, 3)


def visibility_votes(
    points: Array,
    depth: NDArray[np.float32],
    T_cw: Array,
    camera: Camera,
    config: DenseCloudConfig = DenseCloudConfig(),
) -> NDArray[np.int32]:
    """Return the votes of a depth image for and against points.

    Args:
        points: [n, 3] in the world, m.
        depth: [H, W] m, 0 = no reading.
        T_cw: [4, 4] pose of the image, m.
        camera: of the image.
        config: noise, and the weight of free space.

    Returns:
        [n], 1 = the point is seen; negative = all readings within a pixel lie behind the point; 0 =
        neither.
    """
    local = to_local(T_cw, points)
    z = local[:, 2]
    votes = np.zeros(len(points), dtype=np.int32)
    visible = np.flatnonzero(z > _MIN_Z_M)
    columns, rows = np.rint(camera.project(local[visible])).astype(np.int64).T
    inside = (columns >= 0) & (rows >= 0) & (columns < camera.width) & (rows < camera.height)
    visible, columns, rows = visible[inside], columns[inside], rows[inside]

    measured, expected = depth[rows, columns], z[visible]
    nearest = _nearest_reading(depth, np.ones((3, 3), dtype=np.uint8))[rows, columns]
    noise = config.depth_noise[0] + _noise_per_m(camera, config) * expected**2
    has_reading = measured > 0
    is_seen = has_reading & (np.abs(measured - expected) <= noise)
    is_free = has_reading & (nearest > expected + noise)
    votes[visible[is_seen]] = 1
    votes[visible[is_free]] = -config.free_space_weight
    return votes
