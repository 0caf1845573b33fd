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
        """Return the matches of the chosen rows [m] bool."""
        return Matches(self.point_ids[rows], self.keypoints[rows])


@dataclass(frozen=True)
class Projected:
    """Map points projected into a camera.

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

    Args:
        projected: the points, projected by the predicted pose.
        features: keypoints of the frame.
        radius_px: search radius at level 0; it grows with the keypoint's scale up to
            config.max_radius_scale.
        config: descriptor limits.
        max_hamming: largest distance in bits, in place of config.max_hamming.

    Returns:
        Matches, at most one per point and per keypoint.
    """
    limit = config.max_hamming if max_hamming is None else max_hamming
    if len(projected.ids) == 0 or len(features) == 0:
        return Matches(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    reach = radius_px * np.minimum(features.scales, config.max_radius_scale)
    i, j = _candidate_pairs(projected, features, float(reach.max()))
    x, y = projected.pixels.T.take(i, axis=1) - features.undistorted.T.take(j, axis=1)
    near = np.flatnonzero(x * x + y * y <= (reach * reach)[j])
    i, j = i[near], j[near]
    bits = hamming(projected.descriptors[i], features.descriptors[j])
    keep = bits <= limit
    i, j = one_to_one(i[keep], j[keep], bits[keep], config.ratio)
    return Matches(projected.ids[i], j)


def _candidate_pairs(
    projected: Projected, features: Features, reach: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all pairs of a point and a keypoint that are at most one level and `reach` px apart.

    Some pairs that are further apart are returned as well. Keypoints are sorted by level and by
    square cell of that size. The three cells of a row in which a point is searched are then one
    slice of the sorted keypoints; there are nine such slices, of three rows on three levels.

    Returns:
        [k] rows of the points, and [k] rows of the keypoints.
    """
    origin = features.undistorted.min(axis=0) - reach
    # Cells count from 1, so that a border of empty cells surrounds them.
    cells = ((features.undistorted - origin) / reach).astype(np.int64)
    width, height = (cells.max(axis=0) + 2).tolist()
    key = ((features.octaves + 1) * height + cells[:, 1]) * width + cells[:, 0]
    order = np.argsort(key, kind="stable")
    num_levels = features.pyramid.num_levels + 2
    begins = np.r_[0, np.cumsum(np.bincount(key, minlength=num_levels * height * width))]
    point_cells = np.floor((projected.pixels - origin) / reach).astype(np.int64)
    x, y = np.clip(point_cells, 0, (width - 1, height - 1)).T
    offsets = np.arange(-1, 2)[:, None]
    levels = projected.levels + 1 + offsets[:, None]
    # A row at the border may be searched twice, but it is empty.
    rows = (levels * height + np.clip(y + offsets, 0, height - 1)) * width
    low = begins[rows + np.maximum(x - 1, 0)].ravel()
    count = begins[rows + np.minimum(x + 2, width)].ravel() - low
    j = order[np.repeat(low - np.cumsum(count) + count, count) + np.arange(count.sum())]
    return np.repeat(np.tile(np.arange(len(x)), 9), count), j


def one_to_one(
    i: NDArray[np.int64], j: NDArray[np.int64], bits: NDArray[np.int64], ratio: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Reduce candidate pairs to unambiguous one-to-one matches.

    The best j of every i must pass the ratio test; then every j keeps its best i.

    Args:
        i: [k] first row of each pair.
        j: [k] second row of each pair.
        bits: [k] Hamming distance of each pair.
        ratio: share of the second-best distance that the best may have (Lowe's ratio test).

    Returns:
        The rows i and j of the matches.
    """
    order = _sorted_rows(i, bits, j)
    i, j, bits = i[order], j[order], bits[order]
    first = np.r_[True, i[1:] != i[:-1]][: len(i)]
    best = np.flatnonzero(first)
    second = np.minimum(best + 1, len(i) - 1)
    has_second = (second > best) & (i[second] == i[best])
    clear = ~has_second | (bits[best] <= ratio * bits[second])
    i, j, bits = i[best][clear], j[best][clear], bits[best][clear]
    order = _sorted_rows(j, bits, i)
    first = np.r_[True, j[order][1:] != j[order][:-1]][: len(j)]
    return i[order][first], j[order][first]


def _sorted_rows(
    first: NDArray[np.int64], bits: NDArray[np.int64], last: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Sort distinct rows by `first`, then by `bits` (0..256), then by `last`.

    A single combined key sorts faster than three keys.
    """
    return np.argsort((first * 257 + bits) * (int(last.max(initial=0)) + 1) + last)


def match_descriptors(
    ids: NDArray[np.int64],
    descriptors: NDArray[np.uint64],
    features: Features,
    config: MatchingConfig,
) -> Matches:
    """Match mutually nearest descriptors, without a pose.

    ids: [m] map points; descriptors: [m, 4] of these points.
    """
    if len(ids) == 0 or len(features) == 0:
        return Matches(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    # The similarity is 256 minus twice the number of bits that differ.
    similarity = _signs(descriptors) @ _signs(features.descriptors).T
    nearest = similarity.argmax(axis=1)
    rows = np.flatnonzero(similarity.argmax(axis=0)[nearest] == np.arange(len(ids)))
    rows = rows[similarity[rows, nearest[rows]] >= 256 - 2 * config.max_hamming_unguided]
    return Matches(ids[rows], nearest[rows])


def _signs(descriptors: NDArray[np.uint64]) -> NDArray[np.float32]:
    """Map the bits of descriptors [m, 4] to [m, 256], 1 for a set bit and -1 for any other."""
    return bits_of(descriptors).astype(np.float32) * 2 - 1
