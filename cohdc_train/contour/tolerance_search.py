"""Where the coarsest tolerance that keeps a floor of IoU lies."""

from dataclasses import dataclass, field
from math import log

_NARROW = 0.06  # of a logarithm: the bracket is not made narrower
_CLIP = 0.35  # the next tolerance keeps that share of the bracket to either end
_FIRST_STEP = 0.06  # of a logarithm, as long as one end is not known
_AIM, _ENOUGH = (
    0.04,
    0.08,
)  # logarithm of what may be lost over what is: aimed at, and good enough to end with
_LEAST_LOST = 1e-6


@dataclass
class _BracketEnd:
    """One end of the bracket: the logarithm of a tolerance, and what is known of its result."""

    at: float
    vertices: int | None = None
    excess: float = 0.0  # logarithm of what is lost, 1 - IoU, over what may be


@dataclass
class ToleranceBracket:
    """Two tolerances, of which the finer keeps the floor and the coarser does not.

    What is lost grows about as the tolerance, so that on logarithmic scales a line through what is
    known tells where the floor is reached. `at` is the logarithm of the tolerance to try, which
    `add` moves on.
    """

    low: _BracketEnd
    high: _BracketEnd
    allowed: float
    at: float
    _step: float = field(default=_FIRST_STEP, init=False)

    @classmethod
    def of(cls, finest: float, coarsest: float, allowed: float, rise: float) -> "ToleranceBracket":
        """Between two tolerances, px. allowed: 1 - the floor; rise: what is lost per px of
        tolerance.
        """
        low, high, allowed = log(finest), log(coarsest), max(allowed, _LEAST_LOST)
        return cls(
            _BracketEnd(low),
            _BracketEnd(high),
            allowed,
            min(max(log(allowed / rise), low + _NARROW), high - _NARROW),
        )

    def add(self, lost: float, vertices: int, keeps: bool) -> bool:
        """What came out at `at`; whether another tolerance is worth a try.

        It is not when the floor is all but reached, when the bracket is narrow, or when one vertex
        is all that its ends differ by.
        """
        here = _BracketEnd(self.at, vertices, log(max(lost, _LEAST_LOST) / self.allowed))
        if keeps:
            self.low = here
        else:
            self.high = here
        low, high = self.low, self.high
        if (keeps and here.excess > -_ENOUGH) or high.at - low.at < _NARROW:
            return False
        if low.vertices is None or high.vertices is None:
            step, self._step = max(abs(here.excess + _AIM), self._step), 2 * self._step
            at = here.at + (step if keeps else -step)
            self.at = at if low.at < at < high.at else (low.at + high.at) / 2
            return True
        rise = high.excess - low.excess
        share = (-_AIM - low.excess) / rise if rise > 0 else 0.5
        self.at = low.at + (high.at - low.at) * min(max(share, _CLIP), 1 - _CLIP)
        return low.vertices > high.vertices + 1
