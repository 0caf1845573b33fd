"""Run lengths of windows against pycocotools, and boundaries against faster-coco-eval."""

import cv2
import numpy as np
from faster_coco_eval.core import mask as theirs
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pycocotools import mask as rle

from cohdc_train.metrics.rle import boundary_rle, to_rle, window_boundary, window_rle

SIZE = (60, 80)
SEEDS = st.integers(0, 10_000)


def whole_rle(mask: NDArray[np.bool_]) -> dict[str, object]:
    encoded = rle.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": list(encoded["size"]), "counts": encoded["counts"].decode()}


def random_window(seed: int) -> tuple[NDArray[np.bool_], int, int]:
    """Noise of any density, often with full columns, as high or as wide as the image, or empty."""
    rng = np.random.default_rng(seed)
    height, width = (
        int(side) if rng.random() < 0.2 else int(rng.integers(0, side + 1)) for side in SIZE
    )
    top, left = (
        int(rng.integers(0, SIZE[0] - height + 1)),
        int(rng.integers(0, SIZE[1] - width + 1)),
    )
    window = rng.random((height, width)) < rng.choice([0, 0.1, 0.5, 0.95, 1])
    window[:, rng.random(width) < 0.2] = True
    return window, top, left


@given(SEEDS)
@settings(max_examples=300, deadline=None)
def test_window_rle_equals_rle_of_whole_mask(seed: int) -> None:
    window, top, left = random_window(seed)
    mask = np.zeros(SIZE, np.bool_)
    mask[top : top + window.shape[0], left : left + window.shape[1]] = window
    assert window_rle(window, (top, left), SIZE) == whole_rle(mask)


@given(SEEDS)
@settings(max_examples=100, deadline=None)
def test_boundaries_equal_faster_coco_eval(seed: int) -> None:
    """Of the window and of the whole mask; blobs that leave the image among them."""
    rng = np.random.default_rng(seed)
    canvas = np.zeros(SIZE, np.uint8)
    for _ in range(int(rng.integers(1, 4))):
        center, axes = (
            (int(rng.integers(0, 80)), int(rng.integers(0, 60))),
            (int(rng.integers(1, 40)), 9),
        )
        cv2.ellipse(canvas, center, axes, float(rng.integers(0, 180)), 0, 360, 1, -1)
    shape = whole_rle(canvas.astype(np.bool_))
    expected = theirs.decode(theirs.rleToBoundary(shape))
    assert np.array_equal(theirs.decode(boundary_rle(shape, SIZE)), expected)
    (x0, y0, w, h), mask = cv2.boundingRect(canvas), canvas.astype(np.bool_)
    window = np.ascontiguousarray(mask[y0 : y0 + h, x0 : x0 + w])
    found = window_rle(window_boundary(window, SIZE), (y0, x0), SIZE)
    assert np.array_equal(theirs.decode(found), expected)


def test_polygons_have_boundaries_too() -> None:
    square = [[10, 10, 40, 10, 40, 40, 10, 40]]
    inside = theirs.decode(to_rle(square, SIZE)).sum()
    assert inside == 900
    assert (
        theirs.decode(boundary_rle(square, SIZE)).sum() == 900 - 26 * 26
    )  # 2 % of the diagonal are 2 px


def test_empty_mask_has_an_empty_boundary() -> None:
    nothing = whole_rle(np.zeros(SIZE, np.bool_))
    assert boundary_rle(nothing, SIZE) == nothing
