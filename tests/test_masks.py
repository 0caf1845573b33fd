"""Pasting RoI masks: known answers and exact behavior under translation."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cohdc_train.masks import paste_roi_mask


def test_full_mask_fills_exactly_the_pixels_whose_center_is_in_the_box():
    mask = paste_roi_mask(
        np.ones((28, 28), np.float32), np.array([2.5, 1.0, 6.4, 3.6], np.float32), (5, 9)
    )
    expected = np.zeros((5, 9), bool)
    expected[1:4, 2:6] = True  # centers 1.5, 2.5, 3.5 and 2.5 .. 5.5
    np.testing.assert_array_equal(mask, expected)


def test_left_half_of_the_grid_is_the_left_half_of_the_box():
    roi = np.zeros((28, 28), np.float32)
    roi[:, :14] = 1
    mask = paste_roi_mask(roi, np.array([10, 10, 50, 30], np.float32), (40, 60))
    assert mask[10:30, 10:30].all()
    assert mask.sum() == 400


@given(st.integers(0, 30), st.integers(0, 30), st.integers(0, 10_000))
def test_moving_the_box_moves_the_mask(dx, dy, seed):
    rng = np.random.default_rng(seed)
    roi = rng.random((28, 28)).astype(np.float32)
    box = np.array([4.25, 3.5, 20.75, 25.0], np.float32)
    still = paste_roi_mask(roi, box, (80, 80))
    moved = paste_roi_mask(roi, box + np.array([dx, dy, dx, dy], np.float32), (80, 80))
    np.testing.assert_array_equal(np.roll(still, (dy, dx), (0, 1)), moved)


def test_box_outside_the_image_or_without_area_is_empty():
    roi = np.ones((28, 28), np.float32)
    for box in ([-20, -20, -5, -5], [5, 5, 5, 9], [100, 100, 120, 120]):
        assert not paste_roi_mask(roi, np.array(box, np.float32), (50, 50)).any()


def test_box_across_the_border_keeps_its_visible_part():
    mask = paste_roi_mask(
        np.ones((28, 28), np.float32), np.array([-10, -10, 5, 5], np.float32), (20, 20)
    )
    assert mask.sum() == 25
