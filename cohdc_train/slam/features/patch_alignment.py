"""Image patches: cut, warped and aligned (paper eqs. 8 and 9)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import RefinementConfig
from cohdc_train.slam.features.keypoints import ScalePyramid
from cohdc_train.slam.geometry.se3 import Array

_AT_ONCE = 1024  # patches that are warped in one call
Floats = NDArray[np.float32]


class Pyramid:
    """Gray image at the finer levels of the keypoints."""

    def __init__(self, gray: NDArray[np.uint8], scale: ScalePyramid, max_level: int) -> None:
        """Downsample an image [H, W] to the levels 0 to max_level of a pyramid."""
        height, width = gray.shape
        levels = [gray]
        for level in range(1, max_level + 1):
            size = (round(width / scale.factor**level), round(height / scale.factor**level))
            smaller = cv2.resize(levels[-1], size, interpolation=cv2.INTER_LINEAR_EXACT)
            levels.append(np.asarray(smaller, dtype=np.uint8))
        self.levels: list[Floats] = [level.astype(np.float32) for level in levels]

    def cut(
        self, pixels: Array, octaves: NDArray[np.int64], side: int, shift: Array | float = 0.0
    ) -> Floats:
        """Grey values of the square around each of pixels [n, 2] px of level 0. side, and shift [n,
        2]: px of each one's own level.

        Returns [n, side * side], row by row; beyond the border the border's.
        """
        result = np.empty((len(pixels), side * side), dtype=np.float32)
        height, width = self.levels[0].shape
        shift, (right, down) = np.broadcast_to(shift, pixels.shape), patch_grid(side)
        for level in np.unique(octaves).tolist():
            rows = np.flatnonzero(octaves == level)
            image = self.levels[level]
            share = np.array([image.shape[1] / width, image.shape[0] / height])
            places = ((pixels[rows] + 0.5) * share - 0.5 + shift[rows]).astype(np.float32)
            x, y = places[:, :1] + right, places[:, 1:] + down
            result[rows] = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return result


def patch_grid(side: int) -> Floats:
    """[2, side * side] offsets x and y of a square's pixels from its middle, px, row by row."""
    places = np.arange(side, dtype=np.float32) - (side - 1) / 2
    return np.stack([np.tile(places, side), np.repeat(places, side)])


def warp_patches(patches: NDArray[np.uint8], inverse: Array, side: int) -> Floats:
    """[n, side, side]: I_r[A(u)] of eq. 8. inverse: [n, 2, 2] px of the patch per px of the image,
    at their levels.
    """
    result = np.empty((len(patches), side * side), dtype=np.float32)
    patch_px = patches.shape[-1]
    for start in range(0, len(patches), _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        column = patches[some].reshape(-1, patch_px).astype(np.float32)  # one patch below the other
        places = inverse[some].astype(np.float32) @ patch_grid(side) + np.float32(
            (patch_px - 1) / 2
        )
        x, y = np.clip(places, 0, patch_px - 1).transpose(1, 0, 2)
        y += patch_px * np.arange(len(y), dtype=np.float32)[:, None]
        result[some] = cv2.remap(column, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return result.reshape(-1, side, side)


def align(
    pyramid: Pyramid,
    pixels: Array,
    octaves: NDArray[np.int64],
    template: Floats,
    config: RefinementConfig,
) -> tuple[Array, NDArray[np.bool_]]:
    """Minimise eq. 8 over each pixel by inverse composition; image and patch may differ in
    brightness and contrast.

    pixels: [n, 2] px; template: [n, side + 2, side + 2], the patch with one px around it for its
    gradient. Returns [n, 2] shifts, px of each one's level, and [n] bool: False where the patch has
    no texture, leaves its surroundings, or does not look alike.
    """
    n = len(pixels)
    inner = _centered(template[:, 1:-1, 1:-1])
    contrast = np.maximum(np.linalg.norm(inner, axis=1, keepdims=True), 1e-6)
    dx = _centered(0.5 * (template[:, 1:-1, 2:] - template[:, 1:-1, :-2]))
    dy = _centered(0.5 * (template[:, 2:, 1:-1] - template[:, :-2, 1:-1]))
    gradient = np.stack([dx, dy], axis=1)  # [n, 2, k]
    H = (gradient @ gradient.transpose(0, 2, 1)).astype(np.float64) + 1e-3 * np.eye(2)
    active = _least_eigenvalue(H) > config.min_eigenvalue
    descent = np.linalg.inv(H).astype(np.float32) @ gradient
    shift, likeness, side = np.zeros((n, 2)), np.zeros(n), template.shape[1] - 2
    for _ in range(config.max_iterations):
        rows = np.flatnonzero(active)
        if len(rows) == 0:
            break
        seen = _centered(pyramid.cut(pixels[rows], octaves[rows], side, shift[rows]))
        wanted = inner[rows]
        seen *= contrast[rows] / np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), 1e-6)
        likeness[rows] = np.einsum("nk,nk->n", seen, wanted) / contrast[rows, 0] ** 2
        step = (descent[rows] @ (wanted - seen)[..., None])[..., 0]
        shift[rows] += step
        active[rows] = np.abs(step).max(axis=1) > config.epsilon_px
    looks_alike = likeness >= config.min_correlation
    return shift, looks_alike & (np.linalg.norm(shift, axis=1) <= config.max_shift_px)


def _least_eigenvalue(H: Array) -> Array:
    """[n] of symmetric matrices [n, 2, 2]."""
    mean, half = (H[:, 0, 0] + H[:, 1, 1]) / 2, (H[:, 0, 0] - H[:, 1, 1]) / 2
    return np.asarray(mean - np.hypot(half, H[:, 0, 1]))


def _centered(patches: Floats) -> Floats:
    """[n, k]: every patch without its mean."""
    flat = patches.reshape(len(patches), -1)
    return np.asarray(flat - flat.mean(axis=1, keepdims=True), dtype=np.float32)
