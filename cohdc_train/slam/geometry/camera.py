"""Pinhole camera with Brown-Conrady distortion."""

from dataclasses import asdict, dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a pinhole camera with Brown-Conrady distortion.

    Attributes:
        fx: focal length along x, px.
        fy: focal length along y, px.
        cx: principal point x, px.
        cy: principal point y, px.
        width: of the images, px.
        height: of the images, px.
        depth_scale: units of a stored depth image per meter along the optical axis.
        k1: radial distortion, first coefficient.
        k2: radial distortion, second coefficient.
        p1: tangential distortion, first coefficient.
        p2: tangential distortion, second coefficient.
        k3: radial distortion, third coefficient.
        baseline: m from the left camera of a rectified stereo pair to the right one; 0 for a camera
            that measures depth.
        readout_s: s from the first row of the color image to the last (rolling shutter); 0 for a
            global shutter.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    depth_scale: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    baseline: float = 0.0
    readout_s: float = 0.0

    @property
    def distortion(self) -> NDArray[np.float64]:
        """Distortion coefficients [5] in OpenCV's order, all 0 for an ideal lens."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    def matrix(self) -> NDArray[np.float64]:
        """Return the calibration matrix K [3, 3], px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def undistort(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Remove the lens distortion from measured pixels.

        Args:
            pixels: [n, 2] as measured, px.

        Returns:
            [n, 2] px, where an ideal lens would show the same points.
        """
        if not self.distortion.any() or len(pixels) == 0:
            return np.asarray(pixels, dtype=np.float64).copy()
        # With OpenCV's default criteria, errors exceed 0.01 px near the image corners of freiburg1.
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-6)
        points = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        ideal = cv2.undistortImagePoints(points, self.matrix(), self.distortion, None, criteria)
        return np.asarray(ideal, dtype=np.float64).reshape(-1, 2)

    def distort(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Apply the lens distortion; the inverse of `undistort`.

        Args:
            pixels: [n, 2] of an ideal lens, px.

        Returns:
            [n, 2] px, where this lens shows the same points.
        """
        if not self.distortion.any() or len(pixels) == 0:
            return np.asarray(pixels, dtype=np.float64).copy()
        rays = self.backproject(pixels, np.ones(len(pixels))).reshape(-1, 1, 3)
        zero = np.zeros(3)
        measured, _ = cv2.projectPoints(rays, zero, zero, self.matrix(), self.distortion)
        return np.asarray(measured, dtype=np.float64).reshape(-1, 2)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Project points [..., 3] of the camera frame, m, z > 0, to undistorted px [..., 2]."""
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)

    def backproject(
        self, pixels: NDArray[np.float64], depth: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Place undistorted pixels [n, 2] at depths [n], m; returns [n, 3] in the camera frame."""
        x = (pixels[:, 0] - self.cx) / self.fx * depth
        y = (pixels[:, 1] - self.cy) / self.fy * depth
        return np.stack([x, y, depth], axis=1)

    def as_dict(self) -> dict[str, float]:
        """Return the content of this camera's YAML file."""
        return asdict(self)


@cache
def undistortion_maps(
    camera: Camera, pinhole: Camera
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute the maps with which cv2.remap turns a camera's image into that of a pinhole camera.

    Args:
        camera: that took the image.
        pinhole: the camera to imitate, in the same place; its distortion is ignored.
    """
    size = (pinhole.width, pinhole.height)
    matrices = camera.matrix(), camera.distortion, None, pinhole.matrix()
    x, y = cv2.initUndistortRectifyMap(*matrices, size, cv2.CV_32FC1)
    return np.asarray(x, np.float32), np.asarray(y, np.float32)
