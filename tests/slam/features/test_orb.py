"""ORB keypoints: selection under a mask and on a grid, reliable depth, and descriptor matching."""

import numpy as np
import pytest
from plane_world import CAMERA, render, room

from cohdc_train.slam.config import FeatureConfig, MatchingConfig
from cohdc_train.slam.features.depth_sampling import sample_depth
from cohdc_train.slam.features.descriptors import hamming
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.matching import match_descriptors
from cohdc_train.slam.features.orb import OrbExtractor, select_on_grid


def test_masked_extraction_still_reaches_number_of_keypoints() -> None:
    rgb, depth, _ = render(room(), np.eye(4))
    mask = np.zeros((240, 320), dtype=np.bool_)
    mask[:, :150] = True
    extract = OrbExtractor(CAMERA, FeatureConfig(max_keypoints=300))
    features, unmasked = extract(rgb, depth, mask), extract(rgb, depth)
    columns, rows = np.rint(features.pixels).astype(int).T
    assert not mask[rows, columns].any()
    assert (unmasked.pixels[:, 0] < 149).sum() > 60, "without the mask, keypoints lie there"
    assert len(unmasked) >= 300
    assert len(features) >= 300, "the number of keypoints is still reached"


def test_keypoints_spread_over_cells_and_levels() -> None:
    rng = np.random.default_rng(0)
    strong = np.column_stack(
        [rng.uniform(0, 31, size=(300, 2)), np.zeros(300), rng.uniform(100, 200, 300)]
    )
    weak = np.column_stack(
        [[40.0 + 32 * k for k in range(8)], np.full(8, 40.0), np.zeros(8), np.full(8, 5.0)]
    )
    higher = np.array([[10.0, 10.0, 1.0, 7.0], [12.0, 10.0, 1.0, 9.0]])
    table = np.concatenate([strong, weak, higher])
    chosen = select_on_grid(table, np.array([20, 1]), np.array([32.0, 38.4]))
    assert set(range(300, 308)) <= set(chosen.tolist()), (
        "the best keypoint of every cell precedes the second best of any"
    )
    best = np.argsort(-strong[:, 3])[:12]
    assert set(chosen[chosen < 300].tolist()) == set(best.tolist())
    assert chosen[chosen >= 308].tolist() == [309]


def test_earlier_frame_has_no_effect_on_selected_keypoints() -> None:
    rng = np.random.default_rng(0)
    tiles = rng.integers(0, 2, size=(15, 20))
    squares = np.kron(tiles, np.ones((16, 16)))  # two gray levels: all responses are equal
    rgb = np.repeat((80 + 90 * squares)[..., None], 3, axis=2).astype(np.uint8)
    depth = np.full((240, 320), 2.0, dtype=np.float32)
    fresh, used = (
        OrbExtractor(CAMERA, FeatureConfig(max_keypoints=100)),
        OrbExtractor(CAMERA, FeatureConfig(max_keypoints=100)),
    )
    # After an image without keypoints, the next search begins with the lowest threshold.
    used(np.full_like(rgb, 90), depth)
    first, second = fresh(rgb, depth), used(rgb, depth)
    np.testing.assert_array_equal(first.pixels, second.pixels)
    np.testing.assert_array_equal(first.octaves, second.octaves)


def test_depth_is_refused_near_edges_and_masks() -> None:
    depth = np.full((240, 320), 2.0, dtype=np.float32)
    depth[:, 100:] = 3.0
    depth[50, 50] = 0.0
    mask = np.zeros((240, 320), dtype=np.bool_)
    mask[:, 200:] = True
    pixels = np.array([[20.0, 20], [99, 20], [101, 20], [50, 50], [150, 20], [199, 20], [319, 239]])
    got = sample_depth(depth, pixels, FeatureConfig(), mask)
    np.testing.assert_array_equal(np.isnan(got), [False, True, True, True, False, True, True])
    np.testing.assert_allclose(got[[0, 4]], [2.0, 3.0])


def test_hamming_counts_differing_bits() -> None:
    first = np.array([[0, 0, 0, 0], [1, 2, 4, 8]], dtype=np.uint64)
    second = np.array([[2**64 - 1, 0, 0, 3], [1, 2, 4, 8]], dtype=np.uint64)
    assert hamming(first, second).tolist() == [66, 0]


def test_features_refuse_arrays_of_different_length() -> None:
    with pytest.raises(ValueError, match="disagree"):
        Features(
            np.zeros((2, 2)),
            np.zeros((2, 2)),
            np.zeros(3, int),
            np.zeros((2, 4), np.uint64),
            np.zeros(2),
            np.zeros(2, bool),
        )


def test_descriptor_matches_equal_exhaustive_search() -> None:
    rng = np.random.default_rng(0)
    map_descriptors = rng.integers(0, 2**63, (40, 4)).astype(np.uint64)
    frame_descriptors = np.concatenate(
        [
            map_descriptors[rng.permutation(40)[:25]],
            rng.integers(0, 2**63, (20, 4)).astype(np.uint64),
        ]
    )
    frame_descriptors[:, 0] ^= np.uint64(2) ** rng.integers(0, 30, len(frame_descriptors)).astype(
        np.uint64
    )
    n = len(frame_descriptors)
    features = Features(
        np.zeros((n, 2)),
        np.zeros((n, 2)),
        np.zeros(n, np.int64),
        frame_descriptors,
        np.zeros(n),
        np.zeros(n, bool),
    )
    matches = match_descriptors(np.arange(100, 140), map_descriptors, features, MatchingConfig())
    bits = hamming(map_descriptors[:, None], frame_descriptors)
    nearest = (bits == bits.min(axis=0)) & (bits == bits.min(axis=1, keepdims=True)) & (bits <= 60)
    pairs = {(100 + i, j) for i, j in np.argwhere(nearest).tolist()}
    assert set(zip(matches.point_ids.tolist(), matches.keypoints.tolist(), strict=True)) == pairs
    assert len(pairs) == 25
