"""Sampling, warping, and alignment of image patches (paper eqs. 8 and 9)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import RefinementConfig
from cohdc_train.slam.features.keypoints import ScalePyramid
from cohdc_train.slam.geometry.se3 import Array

_PATCHES_PER_CALL = 1024  # OpenCV limits the size of an image that it remaps
Floats = NDArray[np.float32]


class Pyramid:
    """Gray image at the finer levels of the keypoint pyramid."""

    def __init__(self, gray: NDArray[np.uint8], scale: ScalePyramid, max_level: int) -> None:
        """Downsample an image [H, W] uint8 to the levels 0 to max_level of a pyramid."""
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
        """Sample the gray values of a square patch around each pixel.

        Args:
            pixels: [n, 2] centers, px of level 0.
            octaves: [n] pyramid level of each patch.
            side: side of the patches, px of their level.
            shift: [n, 2] offset of the centers, px of their level.

        Returns:
            [n, side * side] values, row by row; the border is replicated outside the image.
        """
        result = np.empty((len(pixels), side * side), dtype=np.float32)
        height, width = self.levels[0].shape
        shift, (right, down) = np.broadcast_to(shift, pixels.shape), patch_grid(side)
        for level in np.unique(octaves).tolist():
            rows = np.flatnonzero(octaves == level)
            image = self.levels[level]
            share = np.array([image.shape[1] / width, image.shape[0] / height])
            positions = ((pixels[rows] + 0.5) * share - 0.5 + shift[rows]).astype(np.float32)
            x, y = positions[:, :1] + right, positions[:, 1:] + down
            result[rows] = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return result


def patch_grid(side: int) -> Floats:
    """Return the offsets [2, side * side] (x, y) of a square's pixels from its center, px."""
    positions = np.arange(side, dtype=np.float32) - (side - 1) / 2
    return np.stack([np.tile(positions, side), np.repeat(positions, side)])


def warp_patches(patches: NDArray[np.uint8], inverse: Array, side: int) -> Floats:
    """Warp patches into a frame by their affine maps: I_r[A(u)] of eq. 8.

    Args:
        patches: [n, h, h] uint8 patches around the points, at their reference keyframes' levels.
        inverse: [n, 2, 2] px of the patch per px of the image, each at its pyramid level.
        side: side of the warped patches, px.

    Returns:
        [n, side, side] gray values.
    """
    result = np.empty((len(patches), side * side), dtype=np.float32)
    patch_px = patches.shape[-1]
    for start in range(0, len(patches), _PATCHES_PER_CALL):
        batch = slice(start, start + _PATCHES_PER_CALL)
        column = (
            patches[batch].reshape(-1, patch_px).astype(np.float32)
        )  # patches stacked vertically
        positions = inverse[batch].astype(np.float32) @ patch_grid(side) + np.float32(
            (patch_px - 1) / 2
        )
        x, y = np.clip(positions, 0, patch_px - 1).transpose(1, 0, 2)
        y += patch_px * np.arange(len(y), dtype=np.float32)[:, None]
        result[batch] = cv2.remap(column, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return result.reshape(-1, side, side)


def align(
    pyramid: Pyramid,
    pixels: Array,
    octaves: NDArray[np.int64],
    template: Floats,
    config: RefinementConfig,
) -> tuple[Array, NDArray[np.bool_]]:
    """Align patches with an image around given pixels (eq. 8, inverse compositional).

    Differences in brightness and contrast are compensated.

    Args:
        pyramid: of the image.
        pixels: [n, 2] initial positions, px of level 0.
        octaves: [n] pyramid level of each patch.
        template: [n, side + 2, side + 2] warped patches with a border of one px for the gradient.
        config: limits of the alignment.

    Returns:
        [n, 2] shifts, px of each patch's level, and [n] bool: False where a patch has no texture,
        shifts too far, or does not correlate with the image.
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
    shift, correlation, side = np.zeros((n, 2)), np.zeros(n), template.shape[1] - 2
    for _ in range(config.max_iterations):
        rows = np.flatnonzero(active)
        if len(rows) == 0:
            break
        sampled = _centered(pyramid.cut(pixels[rows], octaves[rows], side, shift[rows]))
        expected = inner[rows]
        sampled *= contrast[rows] / np.maximum(np.linalg.norm(sampled, axis=1, keepdims=True), 1e-6)
        correlation[rows] = np.einsum("nk,nk->n", sampled, expected) / contrast[rows, 0] ** 2
        step = (descent[rows] @ (expected - sampled)[..., None])[..., 0]
        shift[rows] += step
        active[rows] = np.abs(step).max(axis=1) > config.epsilon_px
    is_correlated = correlation >= config.min_correlation
    return shift, is_correlated & (np.linalg.norm(shift, axis=1) <= config.max_shift_px)


def _least_eigenvalue(H: Array) -> Array:
    """Return the smaller eigenvalue [n] of symmetric matrices [n, 2, 2]."""
    mean, half = (H[:, 0, 0] + H[:, 1, 1]) / 2, (H[:, 0, 0] - H[:, 1, 1]) / 2
    return np.asarray(mean - np.hypot(half, H[:, 0, 1]))


def _centered(patches: Floats) -> Floats:
    """Flatten patches to [n, k], and subtract the mean of each."""
    flat = patches.reshape(len(patches), -1)
    return np.asarray(flat - flat.mean(axis=1, keepdims=True), dtype=np.float32)
