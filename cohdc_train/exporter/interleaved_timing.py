"""Interleaved timing: runners take turns on the same images, so that all share the load."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from cohdc_train.types import Image

K = TypeVar("K")


def time_interleaved(
    runners: Mapping[K, Callable[[Image], Any]], images: Sequence[Image]
) -> dict[K, list[float]]:
    """Measure the time of each runner on each image, in turn.

    The first image is run once before, without being measured.

    Args:
        runners: name -> function of an image.
        images: uint8 [H, W, 3] each.

    Returns:
        Name -> s per image.
    """
    seconds: dict[K, list[float]] = {name: [] for name in runners}
    for image in (images[0], *images):
        for name, run in runners.items():
            start = time.perf_counter()
            run(image)
            seconds[name].append(time.perf_counter() - start)
    return {name: times[1:] for name, times in seconds.items()}
