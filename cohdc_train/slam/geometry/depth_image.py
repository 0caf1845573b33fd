"""Gray images with depth, small enough for direct alignment."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import LoopVerificationConfig
from cohdc_train.slam.geometry.camera import Camera, undistortion_maps

_MASK_KERNEL = np.ones((9, 9))  # dilates a dynamic mask by 4 px


@dataclass(frozen=True)
class DepthImage:
    """Undistorted gray image with depth, as a keyframe keeps it for direct alignment.

    Attributes:
        gray: [h, w] float32.
        depth: [h, w] float32 m, 0 = unknown or dynamic.
        camera: pinhole camera of this image.
    """

    gray: NDArray[np.float32]
    depth: NDArray[np.float32]
    camera: Camera

    def half(self) -> "DepthImage":
        """Return the next level of the pyramid, half as wide and high."""
        full = self.camera
        gray = _float32(cv2.pyrDown(self.gray))
        height, width = gray.shape
        focal, center = (full.fx / 2, full.fy / 2), (full.cx / 2, full.cy / 2)
        camera = Camera(*focal, *center, width, height, full.depth_scale)
        return DepthImage(gray, self.depth[::2, ::2].copy(), camera)


def make_depth_image(
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    mask: NDArray[np.bool_] | None,
    camera: Camera,
    side_px: int = LoopVerificationConfig.image_px,
) -> DepthImage:
    """Undistort and scale down a frame, without depth on the dynamic mask.

    Args:
        rgb: [H, W, 3].
        depth: [H, W] m, 0 = no reading.
        mask: [H, W], True = dynamic.
        camera: that took the frame.
        side_px: longer side of the small image, px.
    """
    scale = side_px / max(camera.width, camera.height)
    small = _scale_camera(camera, scale)
    maps = undistortion_maps(camera, small)

    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    if scale < 1:
        gray = cv2.GaussianBlur(gray, (0, 0), 0.5 / scale)
    if mask is not None:
        dynamic = cv2.dilate(mask.astype(np.uint8), _MASK_KERNEL) > 0
        depth = np.where(dynamic, 0, depth)
    small_depth = cv2.remap(depth.astype(np.float32), *maps, cv2.INTER_NEAREST)
    small_gray = cv2.remap(gray, *maps, cv2.INTER_LINEAR)
    return DepthImage(_float32(small_gray), _float32(small_depth), small)


def _scale_camera(camera: Camera, scale: float) -> Camera:
    """Return the pinhole camera of a scaled image; pixel centers lie at integer coordinates."""
    width, height = round(camera.width * scale), round(camera.height * scale)
    cx, cy = (camera.cx + 0.5) * scale - 0.5, (camera.cy + 0.5) * scale - 0.5
    return Camera(camera.fx * scale, camera.fy * scale, cx, cy, width, height, camera.depth_scale)


def _float32(image: object) -> NDArray[np.float32]:
    return np.asarray(image, dtype=np.float32)
