"""Masks carried by flow and depth: squares whose every move is known."""

import numpy as np
import pytest
from numpy.typing import NDArray
from plane_world import texture

from cohdc_train.slam.dynamics.mask_propagation import (
    HalfResFrame,
    Mask,
    MaskPropagator,
    cut_by_depth,
    downsample,
    downsample_mask,
)

HEIGHT, WIDTH = 240, 320
WALL, PERSON = 3.0, 1.5  # m
_WALLPAPER = texture(np.random.default_rng(1), HEIGHT, WIDTH)
_SHIRT = texture(np.random.default_rng(2), 100, 80, patches=200)


def scene(left: int, depth: float = PERSON) -> tuple[HalfResFrame, Mask]:
    """A textured board, 80 x 100 px, its left edge at `left`, before a wall. Returns the frame and
    the true mask.
    """
    rgb, meters = _WALLPAPER.copy(), np.full((HEIGHT, WIDTH), WALL, dtype=np.float32)
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.bool_)
    begin, end = max(left, 0), min(left + 80, WIDTH)
    rgb[70:170, begin:end] = _SHIRT[:, begin - left : end - left]
    meters[70:170, begin:end] = depth
    mask[70:170, begin:end] = True
    return downsample(rgb, meters), downsample_mask(mask)


def iou(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    return float((first & second).sum() / (first | second).sum())


def test_a_mask_follows_the_square_it_was_made_for() -> None:
    propagation = MaskPropagator()
    frame, mask = scene(100)
    propagation.update(mask, propagation.advance(frame), frame)
    for step in range(1, 7):
        frame, truth = scene(100 + 6 * step)
        propagation.advance(frame)
        carried = propagation.mask()
        assert carried is not None
        assert iou(carried, truth) > 0.95
    assert iou(mask, truth) < 0.5, "the old mask is far off by then"


def test_a_late_mask_is_carried_through_the_frames_that_passed() -> None:
    propagation = MaskPropagator()
    first, mask = scene(100)
    number = propagation.advance(first)
    for step in range(1, 7):
        frame, truth = scene(100 + 6 * step)
        propagation.advance(frame)
    assert propagation.mask() is None, "nothing is known before the first mask"
    propagation.update(mask, number, first)
    carried = propagation.mask()
    assert carried is not None
    assert iou(carried, truth) > 0.95


def test_a_mask_older_than_the_memory_takes_one_leap() -> None:
    propagation = MaskPropagator()
    first, mask = scene(100)
    number = propagation.advance(first)
    for _ in range(60):
        propagation.advance(scene(112)[0])
    propagation.update(mask, number, first)
    carried = propagation.mask()
    assert carried is not None
    assert iou(carried, scene(112)[1]) > 0.95
    assert len(propagation._frames) < 60, "memory is bounded"


def test_a_person_cut_by_the_border_walks_in_masked() -> None:
    propagation = MaskPropagator()
    frame, mask = scene(-40)
    propagation.update(mask, propagation.advance(frame), frame)
    for left in range(-36, 1, 4):
        frame, truth = scene(left)
        propagation.advance(frame)
    carried = propagation.mask()
    assert carried is not None
    assert (carried & truth).sum() > 0.9 * truth.sum()


def test_the_depth_gate_lets_go_what_is_not_as_deep_any_more() -> None:
    propagation = MaskPropagator()
    frame, mask = scene(100)
    propagation.update(mask, propagation.advance(frame), frame)
    propagation.advance(scene(100, depth=PERSON + 0.2)[0])
    kept = propagation.mask()
    assert kept is not None
    assert iou(kept, mask) > 0.95
    propagation.advance(scene(100, depth=WALL)[0])
    gone = propagation.mask()
    assert gone is not None
    assert not gone.any()


@pytest.mark.parametrize("off", [-2, 2], ids=["too small", "too large"])
def test_a_masks_edge_goes_to_where_depth_breaks(off: int) -> None:
    depth = np.full((120, 160), WALL, dtype=np.float32)
    depth[40:80, 50:90] = PERSON
    truth = depth < 2
    rough = np.zeros_like(truth)
    rough[40 - off : 80 + off, 50 - off : 90 + off] = True
    cut = cut_by_depth(rough, depth)
    assert iou(cut, truth) > 0.98 > iou(rough, truth) + 0.05


def test_pixels_without_depth_stay_as_they_are() -> None:
    mask = np.zeros((120, 160), dtype=np.bool_)
    mask[40:80, 50:90] = True
    np.testing.assert_array_equal(cut_by_depth(mask, np.zeros((120, 160), dtype=np.float32)), mask)


def test_feet_do_not_run_out_over_the_floor_they_stand_on() -> None:
    depth = np.full((120, 160), WALL, dtype=np.float32)
    depth[40:80, 50:90] = PERSON
    truth = depth < 2
    depth[80:] = PERSON + 0.05  # the floor; what stands on it reaches down to row 80
    mask = truth.copy()
    mask[40:42] = False  # and a rim is missing where depth breaks
    for _ in range(10):
        mask = cut_by_depth(mask, depth)
    assert not (mask & ~truth)[83:].any(), (
        "but for the corners beside the feet, where wall and floor are mixed"
    )
    assert iou(mask, truth) > 0.97


def test_only_the_edge_is_decided_by_depth() -> None:
    depth = np.full((120, 160), PERSON, dtype=np.float32)
    depth[30:90, 60:75] = PERSON - 0.8  # an arm held out
    np.testing.assert_array_equal(cut_by_depth(np.ones_like(depth, dtype=np.bool_), depth), True)
    mask = np.zeros_like(depth, dtype=np.bool_)
    mask[20:100, 40:120] = True
    assert cut_by_depth(mask, depth)[25:95, 45:115].all()
