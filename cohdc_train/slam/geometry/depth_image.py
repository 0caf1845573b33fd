"""Gray images with depth, small enough for direct alignment."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.geometry.camera import Camera, maps_onto


@dataclass(frozen=True)
class DepthImage:
    """What a keyframe keeps to be aligned.

    gray: [h, w] float32; depth: [h, w] float32 m, 0 = none or dynamic; camera: the picture's own,
    without distortion.
    """

    gray: NDArray[np.float32]
    depth: NDArray[np.float32]
    camera: Camera

    def half(self) -> "DepthImage":
        """Half as wide and high."""
        c = self.camera
        gray = _float32(cv2.pyrDown(self.gray))
        height, width = gray.shape
        camera = Camera(c.fx / 2, c.fy / 2, c.cx / 2, c.cy / 2, width, height, c.depth_scale)
        return DepthImage(gray, self.depth[::2, ::2].copy(), camera)


def make_depth_image(
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    mask: NDArray[np.bool_] | None,
    camera: Camera,
) -> DepthImage:
    """A small picture without distortion. rgb: [H, W, 3]; depth: [H, W] m, 0 = none; mask: [H, W],
    True = dynamic.
    """
    scale = _SIDE / max(camera.width, camera.height)
    width, height = round(camera.width * scale), round(camera.height * scale)
    cx, cy = (camera.cx + 0.5) * scale - 0.5, (camera.cy + 0.5) * scale - 0.5
    small = Camera(camera.fx * scale, camera.fy * scale, cx, cy, width, height, camera.depth_scale)
    maps = maps_onto(camera, small)
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    gray = cv2.GaussianBlur(gray, (0, 0), 0.5 / scale) if scale < 1 else gray
    still = (
        depth
        if mask is None
        else np.where(cv2.dilate(mask.astype(np.uint8), np.ones((9, 9))) > 0, 0, depth)
    )
    readings = cv2.remap(still.astype(np.float32), *maps, cv2.INTER_NEAREST)
    return DepthImage(_float32(cv2.remap(gray, *maps, cv2.INTER_LINEAR)), _float32(readings), small)


def _float32(image: object) -> NDArray[np.float32]:
    return np.asarray(image, dtype=np.float32)


_SIDE = 160  # px of a picture's longer side
