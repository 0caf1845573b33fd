"""Depth of a rectified stereo pair: semi-global matching and the matrix Q (paper eqs. 3 to 5)."""

import time

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.slam.config import StereoConfig
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.sources import SequenceFormat
from cohdc_train.slam.io.tum import TimestampedImage, read_rgb

_DISPARITY_STEP = 16  # OpenCV's disparities are multiples of 1/16 px, their range of 16 px


def reprojection_matrix(camera: Camera) -> NDArray[np.float64]:
    """Return Q [4, 4] of a rectified pair with one K (paper eq. 4).

    Q maps (x, y, disparity, 1) in px to homogeneous coordinates in m. T is the offset of the right
    camera as cv2.stereoRectify has it, -baseline: with it the paper's signs make Z positive.
    """
    T = -camera.baseline
    Q = np.zeros((4, 4))
    Q[0] = 1.0, 0.0, 0.0, -camera.cx
    Q[1] = 0.0, 1.0, 0.0, -camera.cy
    Q[2] = 0.0, 0.0, 0.0, camera.fx
    # (c_x - c_x') / T is 0: both images have the same principal column.
    Q[3] = 0.0, 0.0, -1.0 / T, 0.0
    return Q


def reproject(disparity: NDArray[np.float32], Q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert a disparity image to points (paper eqs. 3 and 5).

    Args:
        disparity: [H, W] px, x_left - x_right, not 0.
        Q: [4, 4] reprojection matrix.

    Returns:
        [H, W, 3] points (X, Y, Z) in the left camera's frame, m.
    """
    y, x = np.indices(disparity.shape, dtype=np.float64)
    homogeneous = np.stack([x, y, disparity, np.ones_like(x)], axis=-1) @ Q.T
    return homogeneous[..., :3] / homogeneous[..., 3:]


class StereoMatcher:
    """Semi-global matcher for a rectified pair."""

    def __init__(self, camera: Camera, config: StereoConfig = StereoConfig()) -> None:
        """Prepare the matcher.

        Args:
            camera: of the left image, with a baseline.
            config: range of disparities and block size.

        Raises:
            DataError: the camera has no baseline, a distortion, or two focal lengths.
        """
        if camera.baseline <= 0:
            raise DataError("a stereo camera's YAML needs baseline: m between the two cameras")
        if camera.distortion.any() or not np.isclose(camera.fx, camera.fy):
            problem = "a rectified stereo pair has fx = fy and no distortion"
            raise DataError(f"{problem}: rectify the images first")
        self._Q = reprojection_matrix(camera)
        max_disparity = camera.width * config.max_disparity_ratio
        block = config.block_px
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=_DISPARITY_STEP * int(np.ceil(max_disparity / _DISPARITY_STEP)),
            blockSize=block,
            P1=8 * block**2,
            P2=32 * block**2,
            disp12MaxDiff=1,  # px between matching left to right and right to left
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )

    def __call__(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Compute the depth of a pair.

        Args:
            left: [H, W, 3] RGB.
            right: [H, W, 3] RGB.

        Returns:
            [H, W] m along the left camera's axis, 0 where nothing matched.
        """
        grays = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right)]
        disparity = self._matcher.compute(*grays).astype(np.float32) / _DISPARITY_STEP
        is_matched = disparity > 0
        safe_disparity = np.where(is_matched, disparity, 1).astype(np.float32)
        Z = reproject(safe_disparity, self._Q)[..., 2]
        return np.where(is_matched, Z, 0).astype(np.float32)


def stereo_format(camera: Camera, config: StereoConfig = StereoConfig()) -> SequenceFormat:
    """Return the format of rectified pairs: left.txt and right.txt; frames are the left camera's.

    Raises:
        DataError: the camera cannot be used, as for `StereoMatcher`.
    """
    matcher = StereoMatcher(camera, config)

    def make_frame(left: TimestampedImage, right: TimestampedImage) -> RGBDFrame:
        rgb, right_rgb = read_rgb(left.path, camera), read_rgb(right.path, camera)
        start = time.perf_counter()
        depth = matcher(rgb, right_rgb)
        return RGBDFrame(
            timestamp=left.timestamp,
            timestamp_text=left.timestamp_text,
            name=left.path.stem,
            rgb=rgb,
            depth=depth,
            depth_ms=1e3 * (time.perf_counter() - start),
        )

    return SequenceFormat("left.txt", "right.txt", config.max_time_difference_s, make_frame)
