"""An exponential moving average of the weights, which is validated, kept and exported."""

from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor


def weight_average(decay: float) -> WeightAveraging:
    """Build Lightning's averaging callback, with a decay that grows to `decay`.

    After n updates the decay is min(decay, (1 + n) / (10 + n)), so that the first steps are soon
    forgotten.

    Raises:
        ValueError: the decay is outside 0..1.
    """
    if not 0 < decay < 1:
        raise ValueError(f"ema {decay}: a decay lies between 0 and 1, such as 0.999")

    def average(averaged: Tensor, current: Tensor, updates: Tensor | int) -> Tensor:
        num_updates = int(updates)
        kept = min(decay, (1 + num_updates) / (10 + num_updates))
        return averaged + (current - averaged) * (1 - kept)

    return WeightAveraging(avg_fn=average)
