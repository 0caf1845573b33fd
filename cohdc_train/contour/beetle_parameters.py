"""Parameters of the beetle antennae search (paper 2.1.3, equation 2)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class BeetleSearch:
    """Parameters of the beetle antennae search, named as the paper names them.

    The paper's k, the number of parameters, is 2 for every beetle: a vertex. All beetles together
    have twice the number of vertices.

    Attributes:
        S: step, the length of the first move after a vertex was dropped, px.
        H: attenuation of the step with every move.
        c: ratio of the step to the whiskers' length d_0 = S / c.
        n: largest number of moves after a vertex was dropped; when they do not lead back to the
            floor, the vertex stays.
        pairs: whiskers of a beetle, in pairs of opposite directions; the paper's has one.
        tries: vertices that are tried before the search ends, the cheapest first; more of an
            outline with many.
        seed: of the random directions.
    """

    S: float = 3.0
    H: float = 0.8
    c: float = 1.0
    n: int = 8
    pairs: int = 4
    tries: int = 2
    seed: int = 0

    @property
    def steps(self) -> list[float]:
        """Length of every move, px."""
        return [self.S * self.H**k for k in range(self.n)]
