"""Timing of things that take turns on the same pictures, so that whatever else the machine does
hits them all.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from cohdc_train.types import Image

K = TypeVar("K")


def seconds_in_turn(
    runners: Mapping[K, Callable[[Image], Any]], pictures: Sequence[Image]
) -> dict[K, list[float]]:
    """What each runner took for each picture, uint8 [H, W, 3], s; the first picture is run once
    before, unmeasured.
    """
    seconds: dict[K, list[float]] = {name: [] for name in runners}
    for picture in (pictures[0], *pictures):
        for name, run in runners.items():
            start = time.perf_counter()
            run(picture)
            seconds[name].append(time.perf_counter() - start)
    return {name: taken[1:] for name, taken in seconds.items()}
