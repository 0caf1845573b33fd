"""Corners: the mask before the budget, the grid, the depth that is trusted; masks made of
detections.
"""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plane_world import CAMERA, render, room

from cohdc_train.errors import DataError
from cohdc_train.segmenter import Detections
from cohdc_train.slam.config import Culling
from cohdc_train.slam.dynamics.mask_sources import dynamic_mask
from cohdc_train.slam.dynamics.masks import dilate_mask
from cohdc_train.slam.features.depth_sampling import sample_depth
from cohdc_train.slam.features.descriptors import hamming
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.matching import match_descriptors
from cohdc_train.slam.features.orb import OrbExtractor, spread


def test_the_mask_costs_no_budget() -> None:
    rgb, depth, _ = render(room(), np.eye(4))
    mask = np.zeros((240, 320), dtype=np.bool_)
    mask[:, :150] = True
    extract = OrbExtractor(CAMERA, budget=300)
    features, unmasked = extract(rgb, depth, mask), extract(rgb, depth)
    columns, rows = np.rint(features.pixels).astype(int).T
    assert not mask[rows, columns].any()
    assert (unmasked.pixels[:, 0] < 149).sum() > 60, "without the mask corners lie there"
    assert len(unmasked) >= 300
    assert len(features) >= 300, "the budget is still filled"


def test_corners_spread_over_cells_and_levels() -> None:
    rng = np.random.default_rng(0)
    strong = np.column_stack(
        [rng.uniform(0, 31, size=(300, 2)), np.zeros(300), rng.uniform(100, 200, 300)]
    )
    weak = np.column_stack(
        [[40.0 + 32 * k for k in range(8)], np.full(8, 40.0), np.zeros(8), np.full(8, 5.0)]
    )
    higher = np.array([[10.0, 10.0, 1.0, 7.0], [12.0, 10.0, 1.0, 9.0]])
    table = np.concatenate([strong, weak, higher])
    chosen = spread(table, quota=np.array([20, 1]))
    assert set(range(300, 308)) <= set(chosen.tolist()), (
        "one weak corner of every cell goes before a crowd's second"
    )
    best = np.argsort(-strong[:, 3])[:12]
    assert set(chosen[chosen < 300].tolist()) == set(best.tolist())
    assert chosen[chosen >= 308].tolist() == [309]


def test_no_earlier_frame_decides_which_corners_are_chosen() -> None:
    rng = np.random.default_rng(0)
    tiles = rng.integers(0, 2, size=(15, 20))
    squares = np.kron(tiles, np.ones((16, 16)))  # corners of two grey levels: responses are alike
    rgb = np.repeat((80 + 90 * squares)[..., None], 3, axis=2).astype(np.uint8)
    depth = np.full((240, 320), 2.0, dtype=np.float32)
    fresh, used = OrbExtractor(CAMERA, 100), OrbExtractor(CAMERA, 100)
    used(
        np.full_like(rgb, 90), depth
    )  # a picture without corners: the next one is sought with the lowest threshold
    first, second = fresh(rgb, depth), used(rgb, depth)
    np.testing.assert_array_equal(first.pixels, second.pixels)
    np.testing.assert_array_equal(first.octaves, second.octaves)


def test_depth_is_refused_beside_edges_and_masks() -> None:
    depth = np.full((240, 320), 2.0, dtype=np.float32)
    depth[:, 100:] = 3.0
    depth[50, 50] = 0.0
    mask = np.zeros((240, 320), dtype=np.bool_)
    mask[:, 200:] = True
    pixels = np.array([[20.0, 20], [99, 20], [101, 20], [50, 50], [150, 20], [199, 20], [319, 239]])
    got = sample_depth(depth, pixels, mask)
    np.testing.assert_array_equal(np.isnan(got), [False, True, True, True, False, True, True])
    np.testing.assert_allclose(got[[0, 4]], [2.0, 3.0])


def test_hamming_counts_bits() -> None:
    first = np.array([[0, 0, 0, 0], [1, 2, 4, 8]], dtype=np.uint64)
    second = np.array([[2**64 - 1, 0, 0, 3], [1, 2, 4, 8]], dtype=np.uint64)
    assert hamming(first, second).tolist() == [66, 0]


def test_features_cannot_disagree_in_shape() -> None:
    with pytest.raises(ValueError, match="disagree"):
        Features(
            np.zeros((2, 2)),
            np.zeros((2, 2)),
            np.zeros(3, int),
            np.zeros((2, 4), np.uint64),
            np.zeros(2),
            np.zeros(2, bool),
        )


def detections(*rows: tuple[tuple[float, float, float, float], int, float, float]) -> Detections:
    """Full boxes: (box, label, score, quality)."""
    return Detections(
        boxes=np.array([row[0] for row in rows], dtype=np.float32).reshape(-1, 4),
        labels=np.array([row[1] for row in rows], dtype=np.int64),
        scores=np.array([row[2] for row in rows], dtype=np.float32),
        quality=np.array([row[3] for row in rows], dtype=np.float32),
        roi_masks=np.ones((len(rows), 28, 28), dtype=np.float32),
        size=(240, 320),
        class_names=("person", "chair"),
    )


def test_doubtful_contours_get_a_wider_band_and_are_never_dropped() -> None:
    box = (100.0, 100.0, 150.0, 150.0)
    culling = Culling(dilate=10)
    sure = dynamic_mask(detections((box, 0, 0.9, 1.0)), frozenset([0]), culling)
    unsure = dynamic_mask(detections((box, 0, 0.9, 0.0)), frozenset([0]), culling)
    assert sure[125, 90]
    assert not sure[125, 88]
    assert unsure[125, 80]
    assert not unsure[125, 78]


def test_without_doubt_all_contours_grow_alike() -> None:
    box = (100.0, 100.0, 150.0, 150.0)
    masks = [
        dynamic_mask(
            detections((box, 0, 0.9, quality)), frozenset([0]), Culling(dilate=10, doubt=0.0)
        )
        for quality in (0.0, 1.0)
    ]
    np.testing.assert_array_equal(*masks)


def test_only_dynamic_classes_above_the_score_count() -> None:
    left, middle, right = (
        (10.0, 10.0, 40.0, 40.0),
        (100.0, 10.0, 140.0, 40.0),
        (200.0, 10.0, 240.0, 40.0),
    )
    found = detections((left, 0, 0.9, 1.0), (middle, 1, 0.9, 1.0), (right, 0, 0.3, 1.0))
    mask = dynamic_mask(found, frozenset([0]), Culling(dilate=0))
    assert mask.sum() == 30 * 30
    assert mask[20, 20]
    assert not dynamic_mask(detections(), frozenset([0]), Culling()).any()


def test_the_papers_filter_leaves_a_doubted_contour_out() -> None:
    box = (10.0, 10.0, 30.0, 30.0)
    for quality, dynamic in ((0.95, True), (0.85, False)):
        found = dynamic_mask(
            detections((box, 0, 0.9, quality)), frozenset([0]), Culling(quality=0.9, dilate=0)
        )
        assert found.any() == dynamic


@given(st.integers(0, 2**32 - 1), st.floats(0.5, 40.0))
@settings(max_examples=30, deadline=None)
def test_grow_looks_at_a_window_and_gives_what_the_whole_image_would(
    seed: int, radius: float
) -> None:
    rng = np.random.default_rng(seed)
    mask = np.zeros((60, 80), bool)
    for row, column in zip(rng.integers(0, 60, 3), rng.integers(0, 80, 3), strict=True):
        mask[row : row + 7, column : column + 4] = True
    whole = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5) <= radius
    assert np.array_equal(dilate_mask(mask, radius), whole)


def test_grow_is_a_disc() -> None:
    mask = np.zeros((41, 41), dtype=np.bool_)
    mask[20, 20] = True
    v, u = np.mgrid[:41, :41]
    exact = np.hypot(u - 20, v - 20)
    grown = dilate_mask(mask, 8.0)
    assert grown[exact < 7.5].all()
    assert not grown[exact > 8.5].any()
    assert dilate_mask(mask, 0.0).sum() == 1


@pytest.mark.parametrize(
    "bad", [{"dilate": -1}, {"score": 1.5}, {"doubt": -0.1}, {"doubt": float("nan")}]
)
def test_culling_refuses_nonsense(bad: dict[str, float]) -> None:
    with pytest.raises(DataError, match=next(iter(bad))):
        Culling(**bad)  # type: ignore[arg-type]


def test_mutually_nearest_descriptors_are_those_of_a_search_through_all() -> None:
    rng = np.random.default_rng(0)
    there = rng.integers(0, 2**63, (40, 4)).astype(np.uint64)
    here = np.concatenate(
        [there[rng.permutation(40)[:25]], rng.integers(0, 2**63, (20, 4)).astype(np.uint64)]
    )
    here[:, 0] ^= np.uint64(2) ** rng.integers(0, 30, len(here)).astype(np.uint64)
    n = len(here)
    features = Features(
        np.zeros((n, 2)),
        np.zeros((n, 2)),
        np.zeros(n, np.int64),
        here,
        np.zeros(n),
        np.zeros(n, bool),
    )
    matches = match_descriptors(np.arange(100, 140), there, features)
    bits = hamming(there[:, None], here)
    nearest = (bits == bits.min(axis=0)) & (bits == bits.min(axis=1, keepdims=True)) & (bits <= 60)
    pairs = {(100 + i, j) for i, j in np.argwhere(nearest).tolist()}
    assert set(zip(matches.points.tolist(), matches.keypoints.tolist(), strict=True)) == pairs
    assert len(pairs) == 25
