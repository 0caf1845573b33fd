"""Hybrid dilated convolution: dilation rates that leave no hole (paper 2.1.1, eq. 1)."""

from collections.abc import Sequence


def max_distance(rates: Sequence[int]) -> int:
    """Compute M_2 of eq. 1: the largest distance between two non-zeros that reach the second layer.

    The paper omits the boundary condition M_n = r_n. It asks for M_2 <= K, which is neither
    necessary nor sufficient (2, 2, 2 passes and leaves holes): `holes` decides, and this value is
    reported with it.

    rates: dilation per layer, first layer first. Returns M_1 for a single layer.
    """
    distance = rates[-1]
    for rate in reversed(rates[1:-1]):
        distance = max(distance - 2 * rate, distance - 2 * (distance - rate), rate)  # eq. 1
    return distance


def receptive_field(rates: Sequence[int], kernel: int = 3) -> int:
    """Return the side of the receptive field of stacked stride-1 layers, px of the input."""
    return 2 * sum(rates) * (kernel // 2) + 1


def holes(rates: Sequence[int], kernel: int = 3) -> list[int]:
    """Return the offsets inside the receptive field that no path through the layers reaches.

    Offsets are pixels along one axis: the support of a dilated kernel is separable, so that one
    axis is enough. Empty when the receptive field is covered.
    """
    reached = {0}
    for rate in rates:
        taps = [rate * tap for tap in range(-(kernel // 2), kernel // 2 + 1)]
        reached = {offset + tap for offset in reached for tap in taps}
    half = receptive_field(rates, kernel) // 2
    return [offset for offset in range(-half, half + 1) if offset not in reached]


def cycle_rates(pattern: Sequence[int], layers: int) -> tuple[int, ...]:
    """Repeat a pattern of rates over so many layers, and check that they leave no hole.

    Raises:
        ValueError: a rate is below 1, or the layers leave holes; the message names them.
    """
    if not pattern or any(rate < 1 for rate in pattern):
        raise ValueError(
            f"HDC rates {tuple(pattern)}: every rate must be a whole number of at least 1"
        )
    rates = tuple(pattern[i % len(pattern)] for i in range(layers))
    missing = holes(rates)
    if missing:
        offsets = ", ".join(str(offset) for offset in missing if offset > 0)
        raise ValueError(
            f"HDC rates {rates} leave holes: offsets +-({offsets}) px of a field of "
            f"{receptive_field(rates)} px are never seen "
            f"(eq. 1: M_2 = {max_distance(rates)}, K = 3)"
        )
    return rates
