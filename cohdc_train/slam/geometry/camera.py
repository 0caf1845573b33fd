"""The pinhole camera with Brown-Conrady distortion: its yaml file, and the choice of one for a
sequence.
"""

from dataclasses import asdict, dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Camera:
    """Intrinsics in px; a stored depth value divided by `depth_scale` is metres along the optical
    axis.

    baseline: m from the left camera of a rectified stereo pair to the right one; 0 for a camera
    that measures depth.
    readout: s from the colour image's first row to its last; 0 for a camera that takes all rows at
    once.
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
    readout: float = 0.0

    @property
    def far(self) -> float:
        """m: depth beyond errs too much to begin with: by 4 cm and more, a Kinect's; 40 baselines,
        a stereo pair's.
        """
        return 40 * self.baseline if self.baseline else 5.0

    @property
    def distortion(self) -> NDArray[np.float64]:
        """[5] Brown-Conrady coefficients in OpenCV's order, all 0 for a lens without."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    def matrix(self) -> NDArray[np.float64]:
        """K: [3, 3], px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def undistort(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """pixels: [n, 2] as measured, px. Returns [n, 2] px where a lens without distortion would
        put them.
        """
        if not self.distortion.any() or len(pixels) == 0:
            return np.asarray(pixels, dtype=np.float64).copy()
        # The default stops at an error of 0.01 px and more in the corners of freiburg1.
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-6)
        points = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        flat = cv2.undistortImagePoints(points, self.matrix(), self.distortion, None, criteria)
        return np.asarray(flat, dtype=np.float64).reshape(-1, 2)

    def distort(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """pixels: [n, 2] without distortion, px. Returns [n, 2] px where the lens puts them:
        undistort's inverse.
        """
        if not self.distortion.any() or len(pixels) == 0:
            return np.asarray(pixels, dtype=np.float64).copy()
        rays = self.backproject(pixels, np.ones(len(pixels))).reshape(-1, 1, 3)
        bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), self.matrix(), self.distortion)
        return np.asarray(bent, dtype=np.float64).reshape(-1, 2)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """points: [..., 3] in the camera frame, m, z > 0. Returns [..., 2] undistorted px."""
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)

    def backproject(
        self, pixels: NDArray[np.float64], depth: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """pixels: [n, 2] undistorted px; depth: [n] m. Returns [n, 3] in the camera frame, m."""
        x = (pixels[:, 0] - self.cx) / self.fx * depth
        y = (pixels[:, 1] - self.cy) / self.fy * depth
        return np.stack([x, y, depth], axis=1)

    def as_dict(self) -> dict[str, float]:
        """What the yaml file of this camera holds."""
        return asdict(self)


@cache
def maps_onto(camera: Camera, pinhole: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What cv2.remap needs to make a camera's image one that a pinhole camera in its place would
    take.
    """
    size = (pinhole.width, pinhole.height)
    matrices = camera.matrix(), camera.distortion, None, pinhole.matrix()
    x, y = cv2.initUndistortRectifyMap(*matrices, size, cv2.CV_32FC1)
    return np.asarray(x, np.float32), np.asarray(y, np.float32)
