"""Geometry: boxes equal their masks' extents, and masks stay on their pixels."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cohdc_train.data.transforms import (
    Augmentation,
    Placement,
    blank_padding,
    mask_boxes,
    photometric_augmentation,
)

sides = st.integers(20, 120)


def draw_image(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return an image whose red channel is 255 exactly under the mask, and the mask."""
    mask = torch.zeros((height, width), dtype=torch.uint8)
    mask[height // 4 : height // 2, width // 5 : width // 2] = 1
    return torch.stack([mask * 255, mask * 0 + 40, mask * 0 + 80]), mask


@settings(max_examples=60, deadline=None)
@given(
    height=sides,
    width=sides,
    rows=sides,
    columns=sides,
    seed=st.integers(0, 99),
    flip=st.booleans(),
)
def test_masks_stay_on_their_pixels_and_crowd_boxes_follow(
    height: int, width: int, rows: int, columns: int, seed: int, flip: bool
) -> None:
    torch.manual_seed(seed)
    pixels, whole = draw_image(height, width)
    placement = Placement.draw((height, width), (rows, columns), Augmentation(flip=float(flip)))
    assert placement.mirrored == flip
    image, mask = placement.image(pixels), placement.mask(whole) > 0
    assert image.shape == (3, rows, columns)
    assert mask.shape == (rows, columns)
    red = image[0].float() > 127
    if mask.sum() < 9:
        return
    edge = mask.float()[None, None]
    # Enlarged bilinearly, a corner is rounded off: (1/2 + a)^2 = 1/2 at a = .21 px of the image
    # from both edges.
    rounded = math.ceil(0.21 * 1.5 * min(rows / height, columns / width) + 0.5)
    inside = -torch.nn.functional.max_pool2d(-edge, 2 * rounded + 1, 1, rounded)[0, 0] > 0
    near = torch.nn.functional.max_pool2d(edge, 3, 1, 1)[0, 0] > 0
    assert not (inside & ~red).any()
    assert not (red & ~near).any()
    box, crowd = mask_boxes(mask[None])[0], placement.boxes(mask_boxes(whole[None]))[0]
    assert torch.allclose(box, crowd, atol=1.0)
    left, top, right, bottom = (int(v) for v in box)
    assert mask[top:bottom, left:right].any(dim=0).all()
    assert mask.sum() == mask[top:bottom, left:right].sum()


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 30), st.integers(1, 30), st.integers(0, 2**31))
def test_mask_boxes_are_the_extents(height: int, width: int, seed: int) -> None:
    masks = np.random.default_rng(seed).random((4, height, width)) > 0.9
    boxes = mask_boxes(torch.from_numpy(masks.astype(np.uint8))).numpy()
    for mask, box in zip(masks, boxes, strict=True):
        y, x = np.nonzero(mask)
        expected = [x.min(), y.min(), x.max() + 1, y.max() + 1] if len(x) else None
        assert list(box) == expected if expected else box[2] == box[3] == 0


def test_without_jitter_the_image_fits_and_the_rest_is_zero() -> None:
    pixels, mask = draw_image(40, 40)
    placement = Placement.draw((40, 40), (60, 100), Augmentation(0.0, (1.0, 1.0)))
    image = placement.image(pixels)
    assert placement.size == (60, 60)
    assert (image[1, :, :60] == 40).all()
    assert (image[:, :, 60:] == 0).all()
    assert mask_boxes(placement.mask(mask)[None]).tolist() == [[12, 15, 30, 30]]


def test_scale_jitter_covers_its_range() -> None:
    torch.manual_seed(0)
    placements = [
        Placement.draw((60, 60), (60, 60), Augmentation(0.5, (0.5, 1.5))) for _ in range(300)
    ]
    scales = [p.size[0] / p.height for p in placements]
    assert 0.5 <= min(scales) < 0.53
    assert 1.47 < max(scales) <= 1.51
    assert len({(p.top, p.left) for p in placements}) > 50
    assert 100 < sum(p.mirrored for p in placements) < 200


@pytest.mark.parametrize("jitter", [(0.0, 1.0), (1.5, 0.5)])
def test_invalid_scale_jitter_is_refused(jitter: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="scale_jitter"):
        Augmentation(scale_jitter=jitter)


def test_probability_above_one_is_refused() -> None:
    with pytest.raises(ValueError, match="copy_paste 2"):
        Augmentation(copy_paste=2)


def test_photometry_changes_every_image_by_itself_and_padding_is_blanked() -> None:
    torch.manual_seed(0)
    images = torch.full((4, 3, 32, 40), 0.5)
    photometry = photometric_augmentation(Augmentation())
    assert photometry is not None
    out = photometry(images.clone())
    assert out.shape == images.shape
    assert len({round(float(image.mean()), 4) for image in out}) > 2
    blank = blank_padding(out, [(20, 40), (32, 30), (32, 40), (1, 1)])
    assert (blank[0, :, 20:] == 0).all()
    assert (blank[1, :, :, 30:] == 0).all()
    assert (blank[2] != 0).any()
    assert (blank[3, :, 1:, 1:] == 0).all()


def test_degraded_images_stay_in_value_range() -> None:
    """All faults together change striped images, which stay in 0..1."""
    torch.manual_seed(0)
    faults = photometric_augmentation(Augmentation(photometric=False, degrade=1.0))
    assert faults is not None
    stripes = (torch.arange(64) // 4 % 2).float().expand(4, 3, 48, 64).clone()
    out = faults(stripes.clone()).clamp(0, 1)
    assert out.shape == stripes.shape
    assert torch.isfinite(out).all()
    assert ((out - stripes).abs().mean(dim=(1, 2, 3)) > 0.02).all()
    contrast = [
        float(image[:, bars > 0].mean() - image[:, bars == 0].mean())
        for image, bars in zip(out, stripes[:, 0], strict=True)
    ]
    assert all(0.1 < value < 0.98 for value in contrast)
    assert len({round(value, 3) for value in contrast}) == 4


def test_no_augmentation_is_none() -> None:
    assert photometric_augmentation(Augmentation(photometric=False)) is None
