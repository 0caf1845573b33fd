"""Log-odds that each map point moves, and the weight of points that follows from them."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import MotionSegmentationConfig
from cohdc_train.slam.geometry.se3 import Array


class StaticOdds:
    """Log-odds of motion of map points.

    moving_log_odds: [rows] one per row of the map, added to those of a new point; 0 or more.
    """

    def __init__(self, config: MotionSegmentationConfig) -> None:
        """Start without rows."""
        self._config = config
        self.moving_log_odds = np.zeros(0)

    def reserve(self, count: int) -> None:
        """Grow to `count` rows."""
        grown = count - len(self.moving_log_odds)
        self.moving_log_odds = np.concatenate([self.moving_log_odds, np.zeros(grown)])

    def reset(self, ids: NDArray[np.int64]) -> None:
        """Set rows to the log-odds of a new point."""
        self.moving_log_odds[ids] = 0.0

    def merge(self, old: NDArray[np.int64], new: NDArray[np.int64]) -> None:
        """Set the points `new` to the larger log-odds of `new` and `old`.

        The same frames have judged both points, so that a sum would count them twice.
        """
        np.maximum.at(self.moving_log_odds, new, self.moving_log_odds[old])

    def update(self, static: NDArray[np.int64], moving: NDArray[np.int64]) -> None:
        """Update the log-odds of the points that a frame observed as static, and as moving."""
        config = self._config
        self.moving_log_odds[static] = np.maximum(
            self.moving_log_odds[static] - config.static_step, 0.0
        )
        self.moving_log_odds[moving] = np.minimum(
            self.moving_log_odds[moving] + config.moving_step, config.max_log_odds
        )

    def weight(self, ids: NDArray[np.int64]) -> Array:
        """Return the weight [n] of points: their probability of being static over a new point's.

        The weight lies in (0, 1].
        """
        prior = self._config.static_log_odds
        return np.asarray((1 + np.exp(-prior)) / (1 + np.exp(self.moving_log_odds[ids] - prior)))
