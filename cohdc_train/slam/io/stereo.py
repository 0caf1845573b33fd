"""Depth from a rectified stereo pair: semi-global matching, then the paper's reprojection matrix Q."""

import time

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.slam.frame import RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.sources import SequenceFormat
from cohdc_train.slam.io.tum import TimestampedImage, read_rgb

_MAX_DIFFERENCE = (
    0.005  # s between the two images of a pair: a walking camera moves 5 mm in that time
)
_NEAREST_SHARE = 0.2  # of the image's width: the largest disparity looked for
_BLOCK = 5  # px


def reprojection_matrix(camera: Camera) -> NDArray[np.float64]:
    """Q of a rectified pair whose cameras share K: [4, 4], from (x, y, disparity, 1) to homogeneous
    metres.

    T is the right camera's offset as cv2.stereoRectify has it, -baseline: with it the paper's signs
    make Z positive.
    """
    T = -camera.baseline
    return np.array(
        [
            [1.0, 0.0, 0.0, -camera.cx],
            [0.0, 1.0, 0.0, -camera.cy],
            [0.0, 0.0, 0.0, camera.fx],
            [
                0.0,
                0.0,
                -1.0 / T,
                0.0,
            ],  # eq. 4; (c_x - c_x') / T is 0, for both images have one principal column
        ]
    )


def reproject(disparity: NDArray[np.float32], Q: NDArray[np.float64]) -> NDArray[np.float64]:
    """[H, W, 3] points (X, Y, Z) in the left camera's frame, m; disparity: [H, W] px = x_left -
    x_right, not 0.
    """
    y, x = np.indices(disparity.shape, dtype=np.float64)
    homogeneous = np.stack([x, y, disparity, np.ones_like(x)], axis=-1) @ Q.T  # eq. 5: (X, Y, Z, W)
    return homogeneous[..., :3] / homogeneous[..., 3:]  # Z = f T / (x_l - x_r), eq. 3


class StereoMatcher:
    """Rectified pair -> depth. Raises DataError for a camera with distortion, two focal lengths, or
    no baseline.
    """

    def __init__(self, camera: Camera) -> None:
        if camera.baseline <= 0:
            raise DataError("a stereo camera's yaml needs baseline: m between the two cameras")
        if camera.distortion.any() or not np.isclose(camera.fx, camera.fy):
            raise DataError(
                "a rectified stereo pair has fx = fy and no distortion: rectify the images first"
            )
        self._Q = reprojection_matrix(camera)
        span = 16 * int(np.ceil(camera.width * _NEAREST_SHARE / 16))
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=span,
            blockSize=_BLOCK,
            P1=8 * _BLOCK**2,
            P2=32 * _BLOCK**2,
            disp12MaxDiff=1,  # px by which matching right to left may disagree
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )

    def __call__(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """left, right: [H, W, 3] RGB. Returns [H, W] m along the left camera's axis, 0 where
        nothing matched.
        """
        pair = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right)]
        disparity = self._matcher.compute(*pair).astype(np.float32) / 16
        matched = disparity > 0
        Z = reproject(np.where(matched, disparity, 1).astype(np.float32), self._Q)[..., 2]
        return np.where(matched, Z, 0).astype(np.float32)


def stereo_format(camera: Camera) -> SequenceFormat:
    """Rectified pairs: left.txt and right.txt; views are the left camera's. Raises DataError as
    StereoMatcher does.
    """
    matcher = StereoMatcher(camera)

    def view(left: TimestampedImage, right: TimestampedImage) -> RGBDFrame:
        pair = read_rgb(left.image, camera), read_rgb(right.image, camera)
        start = time.perf_counter()
        depth = matcher(*pair)
        depth_ms = 1e3 * (time.perf_counter() - start)
        return RGBDFrame(
            left.t,
            pair[0],
            depth,
            timestamp_text=left.stamp,
            name=left.image.stem,
            depth_ms=depth_ms,
        )

    return SequenceFormat("left.txt", "right.txt", _MAX_DIFFERENCE, view)
