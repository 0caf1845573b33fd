"""An exponential moving average of the weights, which is what is validated, kept and exported."""

from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor


def ema(decay: float) -> WeightAveraging:
    """Lightning's averaging, with a decay that grows towards `decay` so that the first steps are
    soon forgotten.

    After n updates it is min(decay, (1 + n) / (10 + n)). Raises ValueError for a decay outside
    0..1.
    """
    if not 0 < decay < 1:
        raise ValueError(f"ema {decay}: a decay lies between 0 and 1, such as 0.999")

    def average(averaged: Tensor, current: Tensor, updates: Tensor | int) -> Tensor:
        n = int(updates)
        kept = min(decay, (1 + n) / (10 + n))
        return averaged + (current - averaged) * (1 - kept)

    return WeightAveraging(avg_fn=average)
