"""Geometry: whatever is drawn, boxes equal their masks' extents and masks stay on their pixels."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchvision import tv_tensors

from cohdc_train.data.transforms import (
    Augmentation,
    JitteredCrop,
    TrainingTransform,
    blank_padding,
    mask_boxes,
    photometric_augmentation,
)

sides = st.integers(20, 120)


def sample(height: int, width: int, crowd: bool = True) -> dict[str, torch.Tensor]:
    """A picture whose red channel is 255 exactly under the mask."""
    mask = torch.zeros((1, height, width), dtype=torch.uint8)
    left, top, right, bottom = width // 5, height // 4, width // 2, height // 2
    mask[0, top:bottom, left:right] = 1
    box = [[left, top, right, bottom]] if crowd else []
    return {
        "image": tv_tensors.Image(torch.cat([mask * 255, mask * 0 + 40, mask * 0 + 80])),
        "masks": tv_tensors.Mask(mask),
        "ignore": tv_tensors.BoundingBoxes(
            torch.tensor(box, dtype=torch.float32).reshape(-1, 4), format="XYXY", canvas_size=(height, width)
        ),
    }


def transformed(
    sample: dict[str, torch.Tensor], canvas: tuple[int, int], augment: Augmentation
) -> dict[str, torch.Tensor]:
    """The sample through the training's transform, its masks one by one."""
    return TrainingTransform(canvas, augment)(sample, list(sample.pop("masks").as_subclass(torch.Tensor)))


@settings(max_examples=60, deadline=None)
@given(height=sides, width=sides, rows=sides, columns=sides, seed=st.integers(0, 99), flip=st.booleans())
def test_masks_stay_on_their_pixels_and_crowd_boxes_follow(
    height: int, width: int, rows: int, columns: int, seed: int, flip: bool
) -> None:
    torch.manual_seed(seed)
    out = transformed(sample(height, width), (rows, columns), Augmentation(flip=float(flip)))
    assert out["image"].shape == (3, rows, columns)
    assert out["masks"].shape == (1, rows, columns)
    red = out["image"][0].float() > 127
    mask = out["masks"][0] > 0
    if mask.sum() < 9:
        return
    edge = mask.float()[None, None]
    # Enlarged bilinearly, a corner is rounded off: (1/2 + a)^2 = 1/2 at a = .21 px of the image from both edges.
    rounded = math.ceil(0.21 * 1.5 * min(rows / height, columns / width) + 0.5)
    inside = -torch.nn.functional.max_pool2d(-edge, 2 * rounded + 1, 1, rounded)[0, 0] > 0
    near = torch.nn.functional.max_pool2d(edge, 3, 1, 1)[0, 0] > 0
    assert not (inside & ~red).any()
    assert not (red & ~near).any()
    box, crowd = mask_boxes(out["masks"])[0], out["ignore"][0]
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
    out = transformed(sample(40, 40), (60, 100), Augmentation(0.0, (1.0, 1.0)))
    assert (out["image"][1, :, :60] == 40).all()
    assert (out["image"][:, :, 60:] == 0).all()
    assert mask_boxes(out["masks"]).tolist() == [[12, 15, 30, 30]]


def test_the_jitter_covers_its_range() -> None:
    crop = JitteredCrop((60, 60), (0.5, 1.5))
    torch.manual_seed(0)
    picture = [tv_tensors.Image(torch.zeros(3, 60, 60, dtype=torch.uint8))]
    params = [crop.make_params(picture) for _ in range(300)]
    scales = [p["size"][0] / p["height"] for p in params]
    assert 0.5 <= min(scales) < 0.53
    assert 1.47 < max(scales) <= 1.51
    assert len({(p["top"], p["left"]) for p in params}) > 50


def test_no_objects_is_no_trouble() -> None:
    empty = sample(30, 40, crowd=False)
    empty["masks"] = tv_tensors.Mask(empty["masks"][:0])
    out = transformed(empty, (50, 50), Augmentation())
    assert out["masks"].shape == (0, 50, 50)
    assert out["ignore"].shape == (0, 4)
    assert mask_boxes(out["masks"]).shape == (0, 4)


@pytest.mark.parametrize("jitter", [(0.0, 1.0), (1.5, 0.5)])
def test_a_senseless_jitter_is_refused(jitter: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="scale_jitter"):
        Augmentation(scale_jitter=jitter)


def test_photometry_changes_every_image_by_itself_and_padding_is_blanked() -> None:
    torch.manual_seed(0)
    images = torch.full((4, 3, 32, 40), 0.5)
    out = photometric_augmentation()(images.clone())
    assert out.shape == images.shape
    assert len({round(float(image.mean()), 4) for image in out}) > 2
    blank = blank_padding(out, [(20, 40), (32, 30), (32, 40), (1, 1)])
    assert (blank[0, :, 20:] == 0).all()
    assert (blank[1, :, :, 30:] == 0).all()
    assert (blank[2] != 0).any()
    assert (blank[3, :, 1:, 1:] == 0).all()
