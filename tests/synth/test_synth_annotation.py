"""Annotations decode, in COCO's own reader, to exactly the mask they were made of."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cohdc_train.contour import pixel_borders
from cohdc_train.synth.coco_annotation import annotate, run_lengths

mask_api = pytest.importorskip("pycocotools.mask")
# pycocotools' arrays lack numpy 2's copy keyword
pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")


def decoded(segmentation: Any, shape: tuple[int, int]) -> np.ndarray:
    coded = mask_api.frPyObjects(segmentation, *shape)
    coded = mask_api.merge(coded) if isinstance(coded, list) else coded
    return mask_api.decode(coded).astype(bool)


@settings(max_examples=150, deadline=None)
@given(mask=arrays(bool, st.tuples(st.integers(2, 14), st.integers(2, 14))))
def test_any_mask_is_annotated_exactly(mask: np.ndarray) -> None:
    np.testing.assert_array_equal(decoded(run_lengths(mask), mask.shape), mask)
    if mask.any():
        annotation = annotate(mask, 3, 9)
        np.testing.assert_array_equal(decoded(annotation["segmentation"], mask.shape), mask)
        assert annotation["area"] == mask.sum()
        x, y, w, h = annotation["bbox"]
        assert mask[y : y + h, x : x + w].sum() == mask.sum()
        assert mask[y].any()
        assert mask[:, x].any()
        assert mask[y + h - 1].any()
        assert mask[:, x + w - 1].any()


def test_simple_parts_are_polygons_and_holes_are_runs() -> None:
    mask = np.zeros((8, 12), dtype=bool)
    mask[1:3, 1:4] = True
    mask[5:7, 6:11] = True
    assert pixel_borders(mask) is not None
    assert sorted(len(p) for p in pixel_borders(mask) or []) == [8, 8]
    assert isinstance(annotate(mask, 1, 1)["segmentation"], list)
    ring = np.ones((5, 5), dtype=bool)
    ring[2, 2] = False
    assert pixel_borders(ring) is None
    assert annotate(ring, 1, 1)["segmentation"] == {"size": [5, 5], "counts": [0, 12, 1, 12]}
