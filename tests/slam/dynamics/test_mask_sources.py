"""Dynamic masks from detections: classes, thresholds, and dilation by quality."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.errors import DataError
from cohdc_train.segmenter import Detections
from cohdc_train.slam.config import MaskConfig
from cohdc_train.slam.dynamics.mask_sources import SegmenterMasks, dynamic_mask
from cohdc_train.slam.dynamics.masks import dilate_mask
from cohdc_train.slam.frame import RGBDFrame

Box = tuple[float, float, float, float]
PERSON = frozenset([0])


def detections(*rows: tuple[Box, int, float, float]) -> Detections:
    """Make detections whose masks fill their boxes. rows: (box, label, score, quality)."""
    return Detections(
        boxes=np.array([row[0] for row in rows], dtype=np.float32).reshape(-1, 4),
        labels=np.array([row[1] for row in rows], dtype=np.int64),
        scores=np.array([row[2] for row in rows], dtype=np.float32),
        quality=np.array([row[3] for row in rows], dtype=np.float32),
        roi_masks=np.ones((len(rows), 28, 28), dtype=np.float32),
        size=(240, 320),
        class_names=("person", "chair"),
    )


class TwoClassSegmenter:
    """Stand-in for a segmenter that detects one person in the left half of every image."""

    class_names = ("person", "chair")

    def __init__(self, quality: float = 1.0, cut_by_quality: bool = False) -> None:
        self.quality = np.full(1, quality, dtype=np.float32)
        self.cut_by_quality = cut_by_quality

    def __call__(self, rgb: np.ndarray) -> Detections:
        height, width = rgb.shape[:2]
        return Detections(
            boxes=np.array([[0, 0, width / 2, height]], dtype=np.float32),
            labels=np.zeros(1, dtype=np.int64),
            scores=np.ones(1, dtype=np.float32),
            quality=self.quality,
            roi_masks=np.ones((1, 28, 28), dtype=np.float32),
            size=(height, width),
            class_names=self.class_names,
        )


@pytest.fixture
def frame() -> RGBDFrame:
    """Return a black frame without depth."""
    rgb, depth = np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320), np.float32)
    return RGBDFrame(0.0, rgb, depth)


def test_contours_of_low_quality_are_dilated_more_and_never_dropped() -> None:
    box = (100.0, 100.0, 150.0, 150.0)
    config = MaskConfig(dilation_px=10)
    confident = dynamic_mask(detections((box, 0, 0.9, 1.0)), PERSON, config)
    doubtful = dynamic_mask(detections((box, 0, 0.9, 0.0)), PERSON, config)
    assert confident[125, 90]
    assert not confident[125, 88]
    assert doubtful[125, 80]
    assert not doubtful[125, 78]


def test_quality_dilation_of_zero_dilates_all_contours_alike() -> None:
    box = (100.0, 100.0, 150.0, 150.0)
    config = MaskConfig(dilation_px=10, quality_dilation=0.0)
    first, second = (
        dynamic_mask(detections((box, 0, 0.9, quality)), PERSON, config) for quality in (0.0, 1.0)
    )
    np.testing.assert_array_equal(first, second)


def test_only_dynamic_classes_above_the_score_are_masked() -> None:
    left = (10.0, 10.0, 40.0, 40.0)
    middle = (100.0, 10.0, 140.0, 40.0)
    right = (200.0, 10.0, 240.0, 40.0)
    found = detections((left, 0, 0.9, 1.0), (middle, 1, 0.9, 1.0), (right, 0, 0.3, 1.0))
    mask = dynamic_mask(found, PERSON, MaskConfig(dilation_px=0))
    assert mask.sum() == 30 * 30
    assert mask[20, 20]
    assert not dynamic_mask(detections(), PERSON, MaskConfig()).any()


@pytest.mark.parametrize(("quality", "is_masked"), [(0.95, True), (0.85, False)])
def test_min_quality_drops_contours_as_the_paper_does(quality: float, is_masked: bool) -> None:
    box = (10.0, 10.0, 30.0, 30.0)
    config = MaskConfig(min_quality=0.9, dilation_px=0)
    mask = dynamic_mask(detections((box, 0, 0.9, quality)), PERSON, config)
    assert mask.any() == is_masked


@given(st.integers(0, 2**32 - 1), st.floats(0.5, 40.0))
@settings(max_examples=30, deadline=None)
def test_dilation_in_a_window_equals_dilation_of_the_whole_image(seed: int, radius: float) -> None:
    rng = np.random.default_rng(seed)
    mask = np.zeros((60, 80), bool)
    for row, column in zip(rng.integers(0, 60, 3), rng.integers(0, 80, 3), strict=True):
        mask[row : row + 7, column : column + 4] = True
    outside = (~mask).astype(np.uint8)
    whole = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_5) <= radius
    assert np.array_equal(dilate_mask(mask, radius), whole)


def test_dilation_of_one_pixel_is_a_disc() -> None:
    mask = np.zeros((41, 41), dtype=np.bool_)
    mask[20, 20] = True
    v, u = np.mgrid[:41, :41]
    distance = np.hypot(u - 20, v - 20)
    dilated = dilate_mask(mask, 8.0)
    assert dilated[distance < 7.5].all()
    assert not dilated[distance > 8.5].any()
    assert dilate_mask(mask, 0.0).sum() == 1


def test_segmenter_masks_only_the_dynamic_classes(frame: RGBDFrame) -> None:
    model = TwoClassSegmenter()
    everything = MaskConfig(dilation_px=0)
    assert SegmenterMasks(model, everything)(frame).mean() == 0.5  # type: ignore[arg-type]
    chairs = MaskConfig(dynamic_classes=("chair",))
    assert not SegmenterMasks(model, chairs)(frame).any()  # type: ignore[arg-type]


def test_unknown_dynamic_class_is_named_with_those_of_the_model() -> None:
    dogs = MaskConfig(dynamic_classes=("dog",))
    with pytest.raises(DataError, match="'dog' is not one of the model's: person, chair"):
        SegmenterMasks(TwoClassSegmenter(), dogs)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("cut_by_quality", "quality_dilation", "px"),
    [(False, None, 20), (True, None, 10), (True, 1.0, 20), (False, 0.0, 10)],
)
def test_masks_that_the_network_cuts_by_quality_get_no_extra_dilation(
    frame: RGBDFrame, cut_by_quality: bool, quality_dilation: float | None, px: int
) -> None:
    config = MaskConfig(dilation_px=10, quality_dilation=quality_dilation)
    masks = SegmenterMasks(TwoClassSegmenter(0.0, cut_by_quality), config)  # type: ignore[arg-type]
    assert masks(frame)[120].sum() == 160 + px
    assert masks.segment(frame)[1] == px
