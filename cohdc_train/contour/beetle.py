"""Beetle antennae search over the vertices of an outline (paper 2.1.3, equation 2)."""

from dataclasses import dataclass, field

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
        n: moves behind a dropped vertex, before the search ends.
        seed: of the random directions.
        k: parameters of one beetle: 2, a vertex. All the beetles together have the paper's k, twice the vertices.
    """

    S: float = 3.0
    H: float = 0.8
    c: float = 2.0
    n: int = 5
    seed: int = 0
    k: int = field(default=2, init=False)


def search_vertices(finer: list[Polygon], iou_floor: float, coverage: Coverage, search: BeetleSearch) -> list[Polygon]:
    """Drop vertices and move the others while the floor is kept.

    finer: polygons that keep the floor. Returns the last ones that keep it and do not cross themselves.
    """
    if vertices(finer) > _MOST_VERTICES:
        return finer
    rng = np.random.default_rng(search.seed)
    beetles = _Beetles(finer, coverage)
    best = finer
    while beetles.drop():
        step = search.S
        for _ in range(search.n):
            beetles.move(step, step / search.c, rng)
            step *= search.H
            if beetles.iou() >= iou_floor:
                break
        else:
            break
        candidate = beetles.polygons()
        if not coverage.keep(candidate, iou_floor):
            break
        best = candidate
    return best


class _Beetles:
    """The vertices of all rings, each the head of a beetle.

    A beetle's f is what its two edges add to the pixels that only one of outline and polygons has. Neighbours do not
    move at the same time, so that the sum falls by what each of them gains.
    """

    def __init__(self, polygons: list[Polygon], coverage: Coverage) -> None:
        rings = [ring for polygon in polygons for ring in polygon.rings]
        self._coverage = coverage
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
            x = self._x[index]
            angle = rng.uniform(0, 2 * np.pi, len(index))
            b = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            felt = self._coverage.nearest(np.stack([x, x + whisker * b, x - whisker * b]))
            f = self._f(index, felt)
            moved = self._coverage.nearest(x - step * b * np.sign(f[1] - f[2])[:, None])[None]
            felt, f = np.concatenate([felt, moved]), np.concatenate([f, self._f(index, moved)])
            self._x[index] = felt[f.argmin(0), np.arange(len(index))]

    def drop(self) -> bool:
        """Take the vertex away that is missed least; False when every ring is a triangle."""
        free = np.repeat(np.array(self._sizes) > 3, self._sizes)
        if not free.any():
            return False
        before, after = self._x[self._before], self._x[self._after]
        without = self._coverage.difference(before, after)
        cost = without - self._f(np.arange(len(self._x)), self._x[None])[0]
        worst = int(np.where(free, cost, np.iinfo(np.int64).max).argmin())
        self._sizes[int(np.searchsorted(np.cumsum(self._sizes), worst, "right"))] -= 1
        self._x = np.delete(self._x, worst, axis=0)
        self._link()
        return True

    def iou(self) -> float:
        """With the outline, 0..1, as long as no ring crosses itself."""
        covered, common = self._coverage.edges(self._x, self._x[self._after])
        return self._coverage.ratio(int(covered.sum()), int(common.sum()))

    def polygons(self) -> list[Polygon]:
        """What the beetles stand around."""
        rings = iter(np.split(self._x, np.cumsum(self._sizes)[:-1]))
        return [Polygon(next(rings), tuple(next(rings) for _ in range(holes))) for holes in self._holes]
