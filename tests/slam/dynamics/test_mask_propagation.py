"""Propagation of masks by optical flow and depth, on boards with known motion."""

import numpy as np
import pytest
from numpy.typing import NDArray
from plane_world import texture

from cohdc_train.slam.dynamics.mask_propagation import (
    HalfResFrame,
    Mask,
    MaskPropagator,
    PropagatedMask,
    downsample,
    downsample_mask,
    snap_to_depth,
)
from cohdc_train.slam.frame import RGBDFrame

HEIGHT, WIDTH = 240, 320
WALL, PERSON = 3.0, 1.5  # m
_WALLPAPER = texture(np.random.default_rng(1), HEIGHT, WIDTH)
_SHIRT = texture(np.random.default_rng(2), 100, 80, patches=200)


def scene(left: int, depth: float = PERSON) -> tuple[HalfResFrame, Mask]:
    """Return a frame of a textured board, 80 x 100 px, before a wall, and the true mask."""
    rgb, meters = _WALLPAPER.copy(), np.full((HEIGHT, WIDTH), WALL, dtype=np.float32)
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.bool_)
    begin, end = max(left, 0), min(left + 80, WIDTH)
    rgb[70:170, begin:end] = _SHIRT[:, begin - left : end - left]
    meters[70:170, begin:end] = depth
    mask[70:170, begin:end] = True
    return downsample(rgb, meters), downsample_mask(mask)


def iou(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    return float((first & second).sum() / (first | second).sum())


def test_mask_follows_a_moving_board() -> None:
    propagator = MaskPropagator()
    frame, mask = scene(100)
    propagator.update(mask, propagator.advance(frame), frame)
    for step in range(1, 7):
        frame, truth = scene(100 + 6 * step)
        propagator.advance(frame)
        propagated = propagator.mask()
        assert propagated is not None
        assert iou(propagated, truth) > 0.95
    assert iou(mask, truth) < 0.5, "the old mask no longer fits"


def test_delayed_mask_is_propagated_through_the_frames_since() -> None:
    propagator = MaskPropagator()
    first, mask = scene(100)
    number = propagator.advance(first)
    for step in range(1, 7):
        frame, truth = scene(100 + 6 * step)
        propagator.advance(frame)
    assert propagator.mask() is None, "no mask yet"
    propagator.update(mask, number, first)
    propagated = propagator.mask()
    assert propagated is not None
    assert iou(propagated, truth) > 0.95


def test_mask_older_than_the_history_is_propagated_in_one_step() -> None:
    propagator = MaskPropagator()
    first, mask = scene(100)
    number = propagator.advance(first)
    for _ in range(60):
        propagator.advance(scene(112)[0])
    propagator.update(mask, number, first)
    propagated = propagator.mask()
    assert propagated is not None
    assert iou(propagated, scene(112)[1]) > 0.95
    assert len(propagator._frames) < 60, "memory is bounded"


def test_person_cut_off_by_the_image_border_walks_in_masked() -> None:
    propagator = MaskPropagator()
    frame, mask = scene(-40)
    propagator.update(mask, propagator.advance(frame), frame)
    for left in range(-36, 1, 4):
        frame, truth = scene(left)
        propagator.advance(frame)
    propagated = propagator.mask()
    assert propagated is not None
    assert (propagated & truth).sum() > 0.9 * truth.sum()


def test_depth_gate_drops_pixels_whose_depth_changed() -> None:
    propagator = MaskPropagator()
    frame, mask = scene(100)
    propagator.update(mask, propagator.advance(frame), frame)
    propagator.advance(scene(100, depth=PERSON + 0.2)[0])
    kept = propagator.mask()
    assert kept is not None
    assert iou(kept, mask) > 0.95
    propagator.advance(scene(100, depth=WALL)[0])
    gone = propagator.mask()
    assert gone is not None
    assert not gone.any()


@pytest.mark.parametrize("off", [-2, 2], ids=["too small", "too large"])
def test_mask_edge_snaps_to_the_depth_edge(off: int) -> None:
    depth = np.full((120, 160), WALL, dtype=np.float32)
    depth[40:80, 50:90] = PERSON
    truth = depth < 2
    rough = np.zeros_like(truth)
    rough[40 - off : 80 + off, 50 - off : 90 + off] = True
    cut = snap_to_depth(rough, depth)
    assert iou(cut, truth) > 0.98 > iou(rough, truth) + 0.05


def test_pixels_without_depth_keep_their_mask() -> None:
    mask = np.zeros((120, 160), dtype=np.bool_)
    mask[40:80, 50:90] = True
    np.testing.assert_array_equal(snap_to_depth(mask, np.zeros((120, 160), dtype=np.float32)), mask)


def test_mask_does_not_leak_from_feet_to_the_floor() -> None:
    depth = np.full((120, 160), WALL, dtype=np.float32)
    depth[40:80, 50:90] = PERSON
    truth = depth < 2
    depth[80:] = PERSON + 0.05  # the floor; the person reaches down to row 80
    mask = truth.copy()
    mask[40:42] = False  # a strip of the mask is missing at the depth edge
    for _ in range(10):
        mask = snap_to_depth(mask, depth)
    assert not (mask & ~truth)[83:].any(), "except beside the feet, where wall and floor are mixed"
    assert iou(mask, truth) > 0.97


def test_depth_decides_only_near_the_mask_edge() -> None:
    depth = np.full((120, 160), PERSON, dtype=np.float32)
    depth[30:90, 60:75] = PERSON - 0.8  # an arm held out
    np.testing.assert_array_equal(snap_to_depth(np.ones_like(depth, dtype=np.bool_), depth), True)
    mask = np.zeros_like(depth, dtype=np.bool_)
    mask[20:100, 40:120] = True
    assert snap_to_depth(mask, depth)[25:95, 45:115].all()


def test_mask_before_the_first_update_is_empty() -> None:
    rgb, depth = np.zeros((HEIGHT, WIDTH, 3), np.uint8), np.ones((HEIGHT, WIDTH), np.float32)
    frame = RGBDFrame(0.0, rgb, depth)
    propagated = PropagatedMask()
    propagated.advance(frame)
    mask = propagated.mask(frame)
    assert mask.shape == (HEIGHT, WIDTH)
    assert not mask.any()
