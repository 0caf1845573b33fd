"""Masks and text drawn over images, and JPEG files."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from cohdc_train.drawing import draw_outline, encode_jpeg, fill_mask, write_jpeg, write_text
from cohdc_train.errors import DataError

RED = (255, 0, 0)


def gray_image() -> np.ndarray:
    return np.full((40, 60, 3), 100, np.uint8)


def ring_mask() -> np.ndarray:
    mask = np.zeros((40, 60), np.bool_)
    mask[10:30, 10:30] = True
    mask[18:22, 18:22] = False
    return mask


def test_fill_mask_blends_color_over_masked_pixels_only() -> None:
    image, mask = gray_image(), ring_mask()
    fill_mask(image, mask, RED, 0.5)
    assert np.array_equal(np.unique(image[mask], axis=0), [[177, 50, 50]])
    assert (image[~mask] == 100).all()


def test_draw_outline_follows_mask_and_its_hole() -> None:
    image = gray_image()
    draw_outline(image, ring_mask(), RED)
    is_red = (image == RED).all(axis=2)
    assert is_red[10, 10:30].all()
    assert is_red[29, 10:30].all()
    assert is_red[17, 18:22].all()
    assert not is_red[13:16, 13:27].any()


def test_write_text_draws_white_letters_with_black_rim() -> None:
    image = gray_image()
    write_text(image, "H1", (5, 30), scale=1.0)
    assert image.min() < 20
    assert image.max() > 235


def test_jpeg_keeps_order_of_color_channels() -> None:
    image = gray_image()
    image[:] = RED
    decoded = cv2.imdecode(np.frombuffer(encode_jpeg(image), np.uint8), cv2.IMREAD_COLOR_RGB)
    assert np.abs(decoded.astype(int) - image).max() <= 2


def test_written_jpeg_has_encoded_bytes_of_its_quality(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (40, 60, 3)).astype(np.uint8)
    write_jpeg(tmp_path / "image.jpg", image, quality=50)
    assert (tmp_path / "image.jpg").read_bytes() == encode_jpeg(image, 50)
    assert len(encode_jpeg(image, 50)) < len(encode_jpeg(image))


def test_jpeg_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    file = tmp_path / "missing" / "image.jpg"
    with pytest.raises(DataError, match=r"image\.jpg: cannot be written"):
        write_jpeg(file, gray_image())
