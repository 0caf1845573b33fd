"""Matching of map points with keypoints, by projection and descriptor."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import MatchingConfig
from cohdc_train.slam.features.descriptors import bits_of, hamming
from cohdc_train.slam.features.keypoints import Features


@dataclass(frozen=True)
class Matches:
    """Map points matched with keypoints of a frame, one to one.

    point_ids: [m] int64 map points; keypoints: [m] int64 rows of the frame's features.
    """

    point_ids: NDArray[np.int64]
    keypoints: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.point_ids)

    def take(self, rows: NDArray[np.bool_]) -> "Matches":
        """The chosen rows."""
        return Matches(self.point_ids[rows], self.keypoints[rows])


@dataclass(frozen=True)
class Projected:
    """Map points as a camera should see them.

    ids: [m] int64; pixels: [m, 2] undistorted px; levels: [m] int64 pyramid level expected;
    descriptors: [m, 4] uint64.
    """

    ids: NDArray[np.int64]
    pixels: NDArray[np.float64]
    levels: NDArray[np.int64]
    descriptors: NDArray[np.uint64]


def match_projected(
    projected: Projected,
    features: Features,
    radius_px: float,
    config: MatchingConfig,
    max_hamming: int | None = None,
) -> Matches:
    """Match each point with the nearest descriptor among the keypoints near its projection.

    radius_px: at level 0; it grows with the keypoint's scale up to config.max_radius_scale.
    max_hamming: bits, in place of config.max_hamming. A keypoint matches one point.
    """
    limit = config.max_hamming if max_hamming is None else max_hamming
    if len(projected.ids) == 0 or len(features) == 0:
        return Matches(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    reach = radius_px * np.minimum(features.scales, config.max_radius_scale)
    i, j = _neighbors(projected, features, float(reach.max()))
    x, y = projected.pixels.T.take(i, axis=1) - features.undistorted.T.take(j, axis=1)
    near = np.flatnonzero(x * x + y * y <= (reach * reach)[j])
    i, j = i[near], j[near]
    bits = hamming(projected.descriptors[i], features.descriptors[j])
    keep = bits <= limit
    i, j = one_to_one(i[keep], j[keep], bits[keep], config.ratio)
    return Matches(projected.ids[i], j)


def _neighbors(
    projected: Projected, features: Features, reach: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a point and a corner, [k] rows of each: all within one level and `reach` px, and
    some further off.

    Corners are sorted by level and square cell of that size. The three cells side by side in which
    a point looks are then one piece of the sorted list; there are nine such pieces, of three rows
    on three levels.
    """
    keypoint = features.undistorted.min(axis=0) - reach
    cells = ((features.undistorted - keypoint) / reach).astype(
        np.int64
    )  # from 1 on: a rim of empty cells lies around
    width, height = (cells.max(axis=0) + 2).tolist()
    key = ((features.octaves + 1) * height + cells[:, 1]) * width + cells[:, 0]
    order = np.argsort(key, kind="stable")
    num_levels = features.pyramid.num_levels + 2
    begins = np.r_[0, np.cumsum(np.bincount(key, minlength=num_levels * height * width))]
    places = np.floor((projected.pixels - keypoint) / reach).astype(np.int64)
    x, y = np.clip(places, 0, (width - 1, height - 1)).T
    beside = np.arange(-1, 2)[:, None]
    levels = projected.levels + 1 + beside[:, None]
    rows = (
        levels * height + np.clip(y + beside, 0, height - 1)
    ) * width  # a row at the rim comes twice, but is empty
    low = begins[rows + np.maximum(x - 1, 0)].ravel()
    count = begins[rows + np.minimum(x + 2, width)].ravel() - low
    j = order[np.repeat(low - np.cumsum(count) + count, count) + np.arange(count.sum())]
    return np.repeat(np.tile(np.arange(len(x)), 9), count), j


def one_to_one(
    i: NDArray[np.int64], j: NDArray[np.int64], bits: NDArray[np.int64], ratio: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Candidate pairs [k] with their distances, thinned: the best j of every i that passes the
    ratio, then of every j the best i."""
    order = _by(i, bits, j)
    i, j, bits = i[order], j[order], bits[order]
    first = np.r_[True, i[1:] != i[:-1]][: len(i)]
    best = np.flatnonzero(first)
    second = np.minimum(best + 1, len(i) - 1)
    has_second = (second > best) & (i[second] == i[best])
    clear = ~has_second | (bits[best] <= ratio * bits[second])
    i, j, bits = i[best][clear], j[best][clear], bits[best][clear]
    order = _by(j, bits, i)
    first = np.r_[True, j[order][1:] != j[order][:-1]][: len(j)]
    return i[order][first], j[order][first]


def _by(
    first: NDArray[np.int64], bits: NDArray[np.int64], last: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The order by first, then bits, 0..256, then last, of rows that all differ: one key sorts
    faster than three.
    """
    return np.argsort((first * 257 + bits) * (int(last.max(initial=0)) + 1) + last)


def match_descriptors(
    ids: NDArray[np.int64],
    descriptors: NDArray[np.uint64],
    features: Features,
    config: MatchingConfig,
) -> Matches:
    """Match mutually nearest descriptors without a pose.

    ids: [m] map points; descriptors: [m, 4] of these points.
    """
    if len(ids) == 0 or len(features) == 0:
        return Matches(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    alike = (
        _signs(descriptors) @ _signs(features.descriptors).T
    )  # 256 bits less twice those that differ
    nearest = alike.argmax(axis=1)
    rows = np.flatnonzero(alike.argmax(axis=0)[nearest] == np.arange(len(ids)))
    rows = rows[alike[rows, nearest[rows]] >= 256 - 2 * config.max_hamming_unguided]
    return Matches(ids[rows], nearest[rows])


def _signs(descriptors: NDArray[np.uint64]) -> NDArray[np.float32]:
    """[m, 256] 1 for each set bit of descriptors [m, 4], -1 for each other."""
    return bits_of(descriptors).astype(np.float32) * 2 - 1
