"""Keypoints with descriptors, undistorted positions and depth."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

SCALE = 1.2  # between two levels of the image pyramid
LEVELS = 8
_PRECISE = 0.3  # px at its level: standard deviation of a corner that was moved to where its point's patch fits best
_SCALES = SCALE ** np.arange(LEVELS)  # px of level 0 per px of each level


@dataclass(frozen=True)
class Keypoints:
    """Where n corners lie in an image, and what they look like; fields as those of Features."""

    pixels: NDArray[np.float64]
    octaves: NDArray[np.int64]
    descriptors: NDArray[np.uint64]
    is_subpixel: NDArray[np.bool_]

    def take(self, rows: NDArray[np.int64]) -> "Keypoints":
        """The chosen rows."""
        return Keypoints(
            self.pixels[rows], self.octaves[rows], self.descriptors[rows], self.is_subpixel[rows]
        )


@dataclass(frozen=True)
class Features:
    """n corners of one frame.

    pixels: [n, 2] float64 as measured, px; points: [n, 2] float64 undistorted, px; octaves: [n]
    int64 pyramid level;
    descriptors: [n, 4] uint64 (256 bits); depths: [n] float64 m, nan where there is no reading or
    it is not trusted;
    precise: [n] bool, known to a fraction of a pixel, by the patch of the point that it belongs to
    (`refinement`).
    """

    pixels: NDArray[np.float64]
    points: NDArray[np.float64]
    octaves: NDArray[np.int64]
    descriptors: NDArray[np.uint64]
    depths: NDArray[np.float64]
    is_subpixel: NDArray[np.bool_]

    def __post_init__(self) -> None:
        n = len(self.pixels)
        arrays = (
            self.pixels,
            self.points,
            self.octaves,
            self.descriptors,
            self.depths,
            self.is_subpixel,
        )
        shapes = tuple(array.shape for array in arrays)
        if shapes != ((n, 2), (n, 2), (n,), (n, 4), (n,), (n,)):
            raise ValueError(f"features disagree in shape: {shapes}")

    def __len__(self) -> int:
        return len(self.pixels)

    def keypoints(self, rows: NDArray[np.int64]) -> Keypoints:
        """The chosen rows, without what camera and depth said of them."""
        return Keypoints(self.pixels, self.octaves, self.descriptors, self.is_subpixel).take(rows)

    @property
    def without_subpixel(self) -> "Features":
        """The same corners as measurements of other points than those by whose patches they are
        precise.
        """
        return replace(self, is_subpixel=np.zeros_like(self.is_subpixel))

    @property
    def scales(self) -> NDArray[np.float64]:
        """[n] px of the image per px of each corner's pyramid level."""
        return np.asarray(SCALE**self.octaves, dtype=np.float64)

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """[n] standard deviation of a corner's position, px: it grows with the pyramid level; less
        where precise.
        """
        return np.where(self.is_subpixel, _PRECISE, 1.0) * self.scales
