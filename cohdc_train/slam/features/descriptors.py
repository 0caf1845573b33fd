"""Binary descriptors and image thumbnails."""

import cv2
import numpy as np
from numpy.typing import NDArray


def bits_of(descriptors: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Unpack descriptors [n, 4] uint64 into bits [n, 256], 0 or 1."""
    return np.unpackbits(np.ascontiguousarray(descriptors).view(np.uint8).reshape(-1, 32), axis=1)


def hamming(first: NDArray[np.uint64], second: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Count the bits, of 256, that differ between descriptors [..., 4]; returns [...]."""
    return np.asarray(np.bitwise_count(first ^ second).sum(axis=-1, dtype=np.int64))


def thumbnail(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Reduce an RGB image [H, W, 3] to a blurred gray thumbnail [30, 40] for relocalization.

    It has zero mean and unit norm, so that the sum of the products of two thumbnails is their
    normalized cross-correlation.
    """
    small = cv2.resize(
        cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (40, 30), interpolation=cv2.INTER_AREA
    )
    image = cv2.GaussianBlur(small.astype(np.float32), (0, 0), 1.5)
    image -= image.mean()
    return np.asarray(image / (np.linalg.norm(image) + 1e-6), dtype=np.float32)
