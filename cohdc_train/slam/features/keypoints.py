"""Keypoints with descriptors, undistorted positions and depth."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import FeatureConfig


@dataclass(frozen=True)
class ScalePyramid:
    """Levels of the image pyramid in which keypoints are detected.

    factor: size ratio of two neighboring levels; num_levels: the image itself included;
    subpixel_sigma_px: standard deviation of a refined keypoint, px at its level.
    """

    factor: float = FeatureConfig.scale_factor
    num_levels: int = FeatureConfig.num_levels
    subpixel_sigma_px: float = FeatureConfig.subpixel_sigma_px

    @classmethod
    def from_config(cls, config: FeatureConfig) -> "ScalePyramid":
        """Return the pyramid that an extractor with these options uses."""
        return cls(config.scale_factor, config.num_levels, config.subpixel_sigma_px)

    def scales(self, octaves: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the scale [n] of pyramid levels [n], px of level 0 per px of the level."""
        return np.asarray(self.factor**octaves, dtype=np.float64)


@dataclass(frozen=True)
class Keypoints:
    """Positions, levels, and descriptors of n keypoints; the fields are those of Features."""

    pixels: NDArray[np.float64]
    octaves: NDArray[np.int64]
    descriptors: NDArray[np.uint64]
    is_subpixel: NDArray[np.bool_]

    def take(self, rows: NDArray[np.int64]) -> "Keypoints":
        """Return the chosen rows."""
        return Keypoints(
            self.pixels[rows], self.octaves[rows], self.descriptors[rows], self.is_subpixel[rows]
        )


@dataclass(frozen=True)
class Features:
    """Keypoints of one frame with undistorted positions and depth.

    pixels: [n, 2] float64 px, as measured; undistorted: [n, 2] float64 px, as a pinhole camera
    would measure them; octaves: [n] int64 pyramid level; descriptors: [n, 4] uint64 (256 bits);
    depths: [n] float64 m, nan where there is no reading or it is refused; is_subpixel: [n] bool,
    refined by the patch of its point; pyramid: the levels that octaves count.
    """

    pixels: NDArray[np.float64]
    undistorted: NDArray[np.float64]
    octaves: NDArray[np.int64]
    descriptors: NDArray[np.uint64]
    depths: NDArray[np.float64]
    is_subpixel: NDArray[np.bool_]
    pyramid: ScalePyramid = ScalePyramid()

    def __post_init__(self) -> None:
        n = len(self.pixels)
        arrays = (
            self.pixels,
            self.undistorted,
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
        """Return the keypoints of the chosen rows, without undistorted positions and depths."""
        return Keypoints(self.pixels, self.octaves, self.descriptors, self.is_subpixel).take(rows)

    def marked_subpixel(self, rows: NDArray[np.int64], is_subpixel: bool) -> "Features":
        """Return a copy in which the chosen rows are marked as refined to subpixels, or as not."""
        marks = self.is_subpixel.copy()
        marks[rows] = is_subpixel
        return replace(self, is_subpixel=marks)

    @property
    def without_subpixel(self) -> "Features":
        """Return a copy in which no keypoint is marked as refined, to measure other points."""
        return replace(self, is_subpixel=np.zeros_like(self.is_subpixel))

    @property
    def scales(self) -> NDArray[np.float64]:
        """Return the scale [n] of each keypoint, px of level 0 per px of its pyramid level."""
        return self.pyramid.scales(self.octaves)

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """Return the standard deviation [n] of each keypoint's position, px of level 0.

        It is one px of the keypoint's level, and less where the keypoint is refined.
        """
        return np.where(self.is_subpixel, self.pyramid.subpixel_sigma_px, 1.0) * self.scales
