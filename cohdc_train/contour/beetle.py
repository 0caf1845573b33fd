"""Beetle antennae search over the vertices of an outline (paper 2.1.3, equation 2)."""

from copy import copy
from dataclasses import dataclass

import numpy as np

from cohdc_train.contour.coverage import Coverage
from cohdc_train.contour.polygons import FloatArray, IntArray, Polygon, vertices

_MOST_VERTICES = 2000  # behind bisection; an outline of more is kept as it is


@dataclass(frozen=True)
class BeetleSearch:
    """Parameters of the beetle antennae search, named as the paper names them.

    Attributes:
        S: step, the length of the first move behind a dropped vertex, px.
        H: attenuation of the step with every move.
        c: ratio of the step to the whiskers' length d_0 = S / c.
        n: most moves behind a dropped vertex; when they do not lead back to the floor, the vertex stays.
        pairs: whiskers of a beetle, in pairs of opposite directions; the paper's has one.
        tries: vertices that are tried before the search ends, those that are missed least first.
        seed: of the random directions.

    The paper's k, the number of parameters, is 2 for every beetle: a vertex. All of them together have twice the
    vertices.
    """

    S: float = 3.0
    H: float = 0.8
    c: float = 2.0
    n: int = 5
    pairs: int = 4
    tries: int = 2
    seed: int = 0


def search_vertices(finer: list[Polygon], iou_floor: float, coverage: Coverage, search: BeetleSearch) -> list[Polygon]:
    """Drop vertices and move the others while the floor is kept.

    finer: polygons that keep the floor. Returns the last ones that keep it and do not cross themselves.
    """
    if vertices(finer) > _MOST_VERTICES:
        return finer
    rng = np.random.default_rng(search.seed)
    beetles = _Beetles(finer, coverage, search.pairs)
    best, failed = finer, 0
    while failed < search.tries and (fewer := beetles.without(failed)) is not None:
        if fewer.settle(iou_floor, search, rng) and coverage.valid(fewer.polygons()):
            beetles, best, failed = fewer, fewer.polygons(), 0
        else:
            failed += 1
    return best


class _Beetles:
    """The vertices of all rings, each the head of a beetle.

    A beetle's f is what its two edges add to the pixels that only one of outline and polygons has. Neighbours do not
    move at the same time, so that the sum falls by what each of them gains.
    """

    def __init__(self, polygons: list[Polygon], coverage: Coverage, pairs: int) -> None:
        rings = [ring for polygon in polygons for ring in polygon.rings]
        self._coverage, self._pairs = coverage, pairs
        self._holes = [len(polygon.holes) for polygon in polygons]
        self._sizes = [len(ring) for ring in rings]
        self._x = np.concatenate(rings)
        self._link()

    def _link(self) -> None:
        """Neighbours of every vertex, and sets of vertices without neighbours among them."""
        ends = np.cumsum(self._sizes)
        starts = ends - self._sizes
        index = np.arange(len(self._x))
        self._before, self._after = index - 1, index + 1
        self._before[starts], self._after[ends - 1] = ends - 1, starts
        place = index - np.repeat(starts, self._sizes)
        turn = place % 2
        turn[(ends - 1)[np.array(self._sizes) % 2 == 1]] = 2
        self._turns = [chosen for i in range(3) if len(chosen := np.flatnonzero(turn == i))]

    def _f(self, index: IntArray, heads: FloatArray) -> IntArray:
        """f of beetles [m] with their heads at [p, m, 2]: [p, m]."""
        places = len(heads)
        before = np.broadcast_to(self._x[self._before[index]], heads.shape).reshape(-1, 2)
        after = np.broadcast_to(self._x[self._after[index]], heads.shape).reshape(-1, 2)
        here = heads.reshape(-1, 2)
        added = self._coverage.difference(np.concatenate([before, here]), np.concatenate([here, after]))
        f: IntArray = added.reshape(2, places, -1).sum(0)
        return f

    def move(self, step: float, whisker: float, rng: np.random.Generator) -> None:
        """One move of every beetle by equation 2; a head goes to the best of the places that were felt.

        step: length of the move, px; whisker: d_0, px. The equation's second line has `step` where the right whisker
        stands; both are d_0 long here. The paper's head walks on from a worse place too, this one stays.
        """
        for index in self._turns:
            x, every = self._x[index], np.arange(len(index))
            angle = rng.uniform(0, np.pi, len(index)) + np.arange(self._pairs)[:, None] * np.pi / self._pairs
            b = np.stack([np.cos(angle), np.sin(angle)], axis=2)  # [pairs, m, 2]
            felt = self._coverage.nearest(np.concatenate([x[None], x + whisker * b, x - whisker * b]))
            f = self._f(index, felt)
            left, right = f[1 : 1 + self._pairs], f[1 + self._pairs :]
            best = np.minimum(left, right).argmin(0)
            towards = b[best, every] * np.sign(left - right)[best, every][:, None]
            moved = self._coverage.nearest(x - step * towards)[None]
            felt, f = np.concatenate([felt, moved]), np.concatenate([f, self._f(index, moved)])
            self._x[index] = felt[f.argmin(0), every]

    def settle(self, iou_floor: float, search: BeetleSearch, rng: np.random.Generator) -> bool:
        """Move until the floor is kept; False when it is not after n moves."""
        step, left = search.S, search.n
        while self.iou() < iou_floor:
            if not left:
                return False
            self.move(step, step / search.c, rng)
            step, left = step * search.H, left - 1
        return True

    def without(self, rank: int) -> "_Beetles | None":
        """All but the vertex that is missed least, or next to least and so on; None when there is no such vertex.

        Triangles keep theirs.
        """
        free = np.flatnonzero(np.repeat(np.array(self._sizes) > 3, self._sizes))
        if rank >= len(free):
            return None
        here = self._x[free]
        without = self._coverage.difference(self._x[self._before[free]], self._x[self._after[free]])
        chosen = int(free[np.argsort(without - self._f(free, here[None])[0], kind="stable")[rank]])
        fewer = copy(self)
        fewer._sizes = self._sizes.copy()
        fewer._sizes[int(np.searchsorted(np.cumsum(self._sizes), chosen, "right"))] -= 1
        fewer._x = np.delete(self._x, chosen, axis=0)
        fewer._link()
        return fewer

    def iou(self) -> float:
        """With the outline, 0..1, as long as no ring crosses itself."""
        return self._coverage.iou_of(self._x, self._x[self._after])

    def polygons(self) -> list[Polygon]:
        """What the beetles stand around."""
        rings = iter(np.split(self._x, np.cumsum(self._sizes)[:-1]))
        return [Polygon(next(rings), tuple(next(rings) for _ in range(holes))) for holes in self._holes]
