"""OpenCV and linear algebra on one thread: the order of their sums cannot change from run to run or
with the number of cores, and no thread of theirs spins where the segmenter works."""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
from threadpoolctl import threadpool_limits


@contextmanager
def single_threaded() -> Iterator[None]:
    """For a `with` block; with a fixed seed of OpenCV's random numbers.

    Both are the whole process's: of two blocks at once the one that ends first takes the other's
    limit with it.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    try:
        with threadpool_limits(1, "blas"):
            yield
    finally:
        cv2.setNumThreads(before)
