"""Find the coarsest tolerance that keeps a floor of the IoU."""

from dataclasses import dataclass, field
from math import log

_MIN_WIDTH = 0.06  # of the bracket, logarithm
_CLIP = 0.35  # smallest distance of the next tolerance to an end, share of the bracket
_FIRST_STEP = 0.06  # logarithm, while one end is not known
_AIM, _ENOUGH = 0.04, 0.08  # logarithm of allowed over actual loss: the aim, and the end
_LEAST_LOST = 1e-6


@dataclass
class _BracketEnd:
    """One end of the bracket.

    Attributes:
        at: logarithm of a tolerance.
        vertices: number of vertices of its result; None before it was tried.
        excess: logarithm of what is lost, 1 - IoU, over what may be.
    """

    at: float
    vertices: int | None = None
    excess: float = 0.0  # logarithm of what is lost, 1 - IoU, over what may be


@dataclass
class ToleranceBracket:
    """Two tolerances, of which the finer keeps the floor and the coarser does not.

    The loss grows about as the tolerance, so that on logarithmic scales a line through the known
    results tells where the floor is reached.

    Attributes:
        low: the finer end.
        high: the coarser end.
        allowed: 1 - the floor.
        at: logarithm of the next tolerance to try, which `add` changes.
    """

    low: _BracketEnd
    high: _BracketEnd
    allowed: float
    at: float
    _step: float = field(default=_FIRST_STEP, init=False)

    @classmethod
    def of(cls, finest: float, coarsest: float, allowed: float, rise: float) -> "ToleranceBracket":
        """Return the bracket between two tolerances, px.

        Args:
            finest: px.
            coarsest: px.
            allowed: 1 - the floor.
            rise: loss per px of tolerance.
        """
        low, high, allowed = log(finest), log(coarsest), max(allowed, _LEAST_LOST)
        return cls(
            _BracketEnd(low),
            _BracketEnd(high),
            allowed,
            min(max(log(allowed / rise), low + _MIN_WIDTH), high - _MIN_WIDTH),
        )

    def add(self, lost: float, vertices: int, keeps: bool) -> bool:
        """Add the result at `at`, and return whether another tolerance is worth a try.

        It is not when the floor is nearly reached, when the bracket is narrow, or when its ends
        differ by one vertex only.
        """
        here = _BracketEnd(self.at, vertices, log(max(lost, _LEAST_LOST) / self.allowed))
        if keeps:
            self.low = here
        else:
            self.high = here
        low, high = self.low, self.high
        if (keeps and here.excess > -_ENOUGH) or high.at - low.at < _MIN_WIDTH:
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
