"""Hybrid dilated convolution: which rates leave no hole (paper 2.1.1, eq. 1). Plain integers, no
tensors.
"""

from collections.abc import Sequence


def max_distance(rates: Sequence[int]) -> int:
    """M_2 of eq. 1: the largest distance between two non-zeros that reach the second layer; M_1 for
    a single layer.

    rates: dilation per layer, first layer first. The paper omits the boundary condition M_n = r_n.
    It asks for M_2 <= K, which is neither necessary nor sufficient (2, 2, 2 passes and leaves
    holes): `holes` decides, this is reported beside it.
    """
    distance = rates[-1]
    for rate in reversed(rates[1:-1]):
        distance = max(distance - 2 * rate, distance - 2 * (distance - rate), rate)  # eq. 1
    return distance


def receptive_field(rates: Sequence[int], kernel: int = 3) -> int:
    """Side, in pixels of the first layer's input, of what one output pixel sees through stacked
    stride-1 layers.
    """
    return 2 * sum(rates) * (kernel // 2) + 1


def holes(rates: Sequence[int], kernel: int = 3) -> list[int]:
    """Offsets inside the receptive field, in pixels along one axis, that no path through the layers
    reaches.

    A dilated kernel is separable in its support, so that one axis tells all. Empty when the
    coverage is whole.
    """
    reached = {0}
    for rate in rates:
        taps = [rate * tap for tap in range(-(kernel // 2), kernel // 2 + 1)]
        reached = {offset + tap for offset in reached for tap in taps}
    half = receptive_field(rates, kernel) // 2
    return [offset for offset in range(-half, half + 1) if offset not in reached]


def cycle(pattern: Sequence[int], layers: int) -> tuple[int, ...]:
    """`pattern` repeated over `layers` convolutions and checked.

    Raises ValueError that names the holes when the convolutions do not cover their receptive field.
    """
    if not pattern or any(rate < 1 for rate in pattern):
        raise ValueError(
            f"HDC rates {tuple(pattern)}: every rate must be a whole number of at least 1"
        )
    rates = tuple(pattern[i % len(pattern)] for i in range(layers))
    missing = holes(rates)
    if missing:
        named = ", ".join(str(offset) for offset in missing if offset > 0)
        raise ValueError(
            f"HDC rates {rates} leave holes: offsets +-({named}) px of a field of {receptive_field(rates)} px are "
            f"never seen (eq. 1: M_2 = {max_distance(rates)}, K = 3)"
        )
    return rates
