"""Image files of every kind are found and read."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from cohdc_train.exporter.sample_images import read_samples
from cohdc_train.images import IMAGE_SUFFIXES


@pytest.mark.parametrize("suffix", sorted(IMAGE_SUFFIXES))
def test_export_reads_every_image_suffix(tmp_path: Path, suffix: str) -> None:
    gray = np.full((8, 10, 3), 90, np.uint8)
    assert cv2.imwrite(str(tmp_path / f"image{suffix}"), gray)

    (image,) = read_samples(tmp_path, 5)

    assert image.shape == (8, 10, 3)
