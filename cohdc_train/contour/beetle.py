"""Beetle antennae search over the vertices of an outline (paper 2.1.3, equation 2)."""

from copy import copy
from dataclasses import dataclass

import numpy as np

from cohdc_train.contour.coverage import Coverage
from cohdc_train.contour.polygons import FloatArray, IntArray, Polygon, vertices

_MOST_VERTICES = 2000  # behind bisection; an outline of more is kept as it is
_DENSE = 10  # of an outline with many vertices one of so many is tried before the search ends
_ROOM = 0.35  # of the shorter of its edges: further no vertex moves at a time


@dataclass(frozen=True)
class BeetleSearch:
    """Parameters of the beetle antennae search, named as the paper names them.

    Attributes:
        S: step, the length of the first move behind a dropped vertex, px.
        H: attenuation of the step with every move.
        c: ratio of the step to the whiskers' length d_0 = S / c.
        n: most moves behind a dropped vertex; when they do not lead back to the floor, the vertex stays.
        pairs: whiskers of a beetle, in pairs of opposite directions; the paper's has one.
        tries: vertices that are tried before the search ends, those that are missed least first; more of an outline
            with many.
        seed: of the random directions.

    The paper's k, the number of parameters, is 2 for every beetle: a vertex. All of them together have twice the
    vertices.
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
        """The length of every move, px."""
        return [self.S * self.H**k for k in range(self.n)]


def search_vertices(finer: list[Polygon], iou_floor: float, coverage: Coverage, search: BeetleSearch) -> list[Polygon]:
    """Drop vertices and move the others while the floor is kept.

    When no vertex can be dropped, all move n times for a higher IoU. Then there is another round, which ends the search
    when it drops nothing.

    finer: polygons that keep the floor. Returns the last ones that keep it and do not cross themselves.
    """
    if vertices(finer) > _MOST_VERTICES:
        return finer
    rng = np.random.default_rng(search.seed)
    beetles, best, moved = _Beetles(finer, coverage, search.pairs), finer, False
    while True:
        for dropped in beetles.least_missed()[: max(search.tries, vertices(best) // _DENSE)]:
            fewer = beetles.without(dropped)
            if fewer.settle(iou_floor, search, rng) and coverage.valid(fewer.polygons()):
                beetles, best, moved = fewer, fewer.polygons(), False
                break
        else:
            if moved:
                return best
            better, moved = beetles.moved(search, rng), True
            if better.iou() < beetles.iou() or not coverage.valid(better.polygons()):
                return best
            beetles, best = better, better.polygons()


class _Beetles:
    """The vertices of all rings, each the head of a beetle.

    A beetle's f is what its two edges add to the pixels that only one of outline and polygons has. Neighbours do not
    move at the same time, so that the sum falls by what each of them gains.
    """

    def __init__(self, polygons: list[Polygon], coverage: Coverage, pairs: int) -> None:
        rings = [ring for polygon in polygons for ring in polygon.rings]
        self._coverage = coverage
        self._spread = np.arange(pairs)[:, None] * np.pi / pairs
        self._owner = np.array([k for k, polygon in enumerate(polygons) for _ in polygon.rings])  # of every ring
        self._sizes = np.array([len(ring) for ring in rings])
        self._x = np.concatenate(rings)
        self._link()

    def _link(self) -> None:
        """Neighbours of every vertex, its place in its ring and the ring's size."""
        ends = np.cumsum(self._sizes)
        starts = ends - self._sizes
        index = np.arange(len(self._x))
        self._before, self._after = index - 1, index + 1
        self._before[starts], self._after[ends - 1] = ends - 1, starts
        self._size = self._sizes.repeat(self._sizes)
        self._place = index - starts.repeat(self._sizes)

    def _turns(self, first: int) -> list[IntArray]:
        """Two sets without neighbours among them; of an odd ring one vertex is in none, another for every `first`."""
        place = (self._place + first) % self._size
        odd = place % 2 == 1
        return [np.flatnonzero(odd), np.flatnonzero(~odd & (place < self._size - 1))]

    def _f(self, index: IntArray, heads: FloatArray) -> IntArray:
        """f of beetles [m] with their heads at [p, m, 2]: [p, m]."""
        start = np.empty((2, *heads.shape))
        start[0], start[1] = self._x[self._before[index]], self._x[self._after[index]]
        added = self._coverage.difference(start.reshape(-1, 2), np.concatenate([heads, heads]).reshape(-1, 2))
        added = added.reshape(2, *heads.shape[:2])
        f: IntArray = added[0] - added[1]
        return f

    def move(self, step: float, whisker: float, first: int, rng: np.random.Generator) -> None:
        """One move of every beetle by equation 2; a head goes to the best of the places that were felt.

        step: length of the move, px; whisker: d_0, px; both are shorter where edges are short, so that rings cross
        less often. first: where the first turn begins. The equation's second line has `step` where the right whisker
        stands; both are d_0 long here. The paper's head walks on from a worse place too, this one stays.
        """
        along = np.hypot(*(self._x[self._after] - self._x).T)
        room = np.minimum(1, _ROOM * np.minimum(along, along[self._before]) / step)
        angle = rng.uniform(0, np.pi, len(room)) + self._spread
        b = np.stack([room * np.cos(angle), room * np.sin(angle)], axis=2)  # [pairs, V, 2]
        pairs = len(b)
        whiskers = np.concatenate([np.zeros((1, len(room), 2)), whisker * b, -whisker * b])
        for index in self._turns(first):
            x, every = self._x[index], np.arange(len(index))
            felt = self._coverage.nearest(x + whiskers[:, index])
            f = self._f(index, felt)
            if step != whisker:
                left, right = f[1 : 1 + pairs], f[1 + pairs :]
                best = np.minimum(left, right).argmin(0)
                towards = b[best, index] * np.sign(left - right)[best, every][:, None]
                moved = self._coverage.nearest(x - step * towards)[None]
                felt, f = np.concatenate([felt, moved]), np.concatenate([f, self._f(index, moved)])
            self._x[index] = felt[f.argmin(0), every]

    def settle(self, iou_floor: float, search: BeetleSearch, rng: np.random.Generator) -> bool:
        """Move until the floor is kept; False when it is not after n moves, or will not be as far as one can tell."""
        ious = [self.iou()]
        for k, step in enumerate(search.steps):
            if ious[-1] >= iou_floor:
                return True
            if k > 1 and 2 * ious[-1] - ious[-3] < iou_floor:  # moves to come are worth less than the last two
                return False
            self.move(step, step / search.c, k, rng)
            ious.append(self.iou())
        return ious[-1] >= iou_floor

    def moved(self, search: BeetleSearch, rng: np.random.Generator) -> "_Beetles":
        """The same after n moves."""
        other = copy(self)
        other._x = self._x.copy()
        for k, step in enumerate(search.steps):
            other.move(step, step / search.c, k, rng)
        return other

    def least_missed(self) -> list[IntArray]:
        """Vertices that may be dropped, those first that are missed least for their number.

        One by one, but for triangles: as a whole, if they are no outer ring with holes nor the last outer ring.
        """
        x, ends = self._x, np.cumsum(self._sizes)
        around, across = self._coverage.difference(
            np.concatenate([x, x[self._before]]), np.concatenate([x[self._after], x[self._after]])
        ).reshape(2, -1)
        missed = (across - around - around[self._before]).astype(np.float64)
        for ring in np.flatnonzero(self._sizes == 3).tolist():
            start, end = ends[ring] - 3, ends[ring]
            missed[start] = -around[start:end].sum() / 3 if self._spare(ring) else np.inf
            missed[start + 1 : end] = np.inf
        order = np.argsort(missed, kind="stable")
        return [np.arange(i, i + (3 if self._size[i] == 3 else 1)) for i in order[np.isfinite(missed[order])]]

    def _spare(self, ring: int) -> bool:
        """Whether a ring may go as a whole."""
        owner = self._owner
        if ring and owner[ring - 1] == owner[ring]:
            return True
        return owner[0] != owner[-1] and not (ring + 1 < len(owner) and owner[ring + 1] == owner[ring])

    def without(self, dropped: IntArray) -> "_Beetles":
        """All but some vertices of a ring: one, or the whole ring."""
        fewer = copy(self)
        ring = int(np.searchsorted(np.cumsum(self._sizes), dropped[0], "right"))
        fewer._sizes = self._sizes.copy()
        fewer._sizes[ring] -= len(dropped)
        kept = fewer._sizes > 0
        fewer._sizes, fewer._owner = fewer._sizes[kept], self._owner[kept]
        fewer._x = np.delete(self._x, dropped, axis=0)
        fewer._link()
        return fewer

    def iou(self) -> float:
        """With the outline, 0..1."""
        return self._coverage.iou_of(self._x, self._x[self._after])

    def polygons(self) -> list[Polygon]:
        """What the beetles stand around."""
        parts: dict[int, list[FloatArray]] = {}
        for owner, ring in zip(self._owner.tolist(), np.split(self._x, np.cumsum(self._sizes)[:-1]), strict=True):
            parts.setdefault(owner, []).append(ring)
        return [Polygon(outer, tuple(holes)) for outer, *holes in parts.values()]
