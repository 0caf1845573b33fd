"""Numerical libraries on one thread, so that results repeat and cores stay free."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
from threadpoolctl import threadpool_limits


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit OpenCV and linear algebra to one thread in a `with` block, and fix OpenCV's seed.

    Sums then have the same order on any machine, and no idle thread spins where the segmenter
    works. The limits are those of the process: of two blocks at the same time, the one that ends
    first ends the other's limit.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    try:
        with threadpool_limits(1, "blas"):
            yield
    finally:
        cv2.setNumThreads(before)
