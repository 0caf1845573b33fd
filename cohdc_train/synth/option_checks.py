"""Checks of the options that every kind of rendered data has."""

from cohdc_train.errors import DataError

MIN_SIDE_PX = 48


def check_size_and_seed(size: tuple[int, int], seed: int) -> None:
    """Check the size of the images and the seed.

    Args:
        size: (height, width), px.
        seed: of the random numbers.

    Raises:
        DataError: a side is too short, or the seed is negative.
    """
    if min(size) < MIN_SIDE_PX:
        height, width = size
        limit = f"height and width are at least {MIN_SIDE_PX}"
        raise DataError(f"size: {height} x {width} px is too small; {limit}")
    if seed < 0:
        raise DataError(f"seed: {seed} is negative")
