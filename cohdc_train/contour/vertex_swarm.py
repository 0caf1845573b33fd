"""Vertices of an outline that move as beetles (paper 2.1.3, equation 2)."""

from copy import copy

import numpy as np

from cohdc_train.contour.beetle_parameters import BeetleSearch
from cohdc_train.contour.polygon_iou import IoUEvaluator
from cohdc_train.contour.polygons import Polygon
from cohdc_train.types import FloatArray, IntArray

_LONG = 6  # vertices of a ring that keeps three when every other one is dropped
_ROOM = 0.35  # of its shorter edge: longest move of a vertex


class VertexSwarm:
    """Vertices of all rings, each the head of a beetle.

    A beetle's f is what its two edges add to the pixels that only one of outline and polygons has.
    Neighbors do not move together, so that the sum falls by what each of them gains.
    """

    def __init__(self, polygons: list[Polygon], evaluator: IoUEvaluator, pairs: int) -> None:
        """Take the vertices of polygons, for beetles of `pairs` pairs of whiskers."""
        rings = [ring for polygon in polygons for ring in polygon.rings]
        self._evaluator = evaluator
        self._spread = np.arange(pairs)[:, None] * np.pi / pairs
        owners = [k for k, polygon in enumerate(polygons) for _ in polygon.rings]
        self._owner = np.array(owners)  # polygon of every ring
        self._sizes = np.array([len(ring) for ring in rings])
        self._x = np.concatenate(rings)  # [V, 2]
        self._link()
        _, self._apart = evaluator.count_pixels(*self._edges())

    def _link(self) -> None:
        """Set the neighbors of every vertex, its place in its ring and the ring's size."""
        ends = np.cumsum(self._sizes)
        starts = ends - self._sizes
        index = np.arange(len(self._x))
        self._before, self._after = index - 1, index + 1
        self._before[starts], self._after[ends - 1] = ends - 1, starts
        self._size = self._sizes.repeat(self._sizes)
        self._place = index - starts.repeat(self._sizes)

    @property
    def count(self) -> int:
        """Number of vertices."""
        return len(self._before)

    def _edges(self) -> tuple[FloatArray, FloatArray]:
        return self._x, self._x.take(self._after, axis=0)

    def _turns(self, first: int) -> list[IntArray]:
        """Return two sets of vertices without neighbors among them.

        Of an odd ring one vertex is in neither; another one for every `first`.
        """
        place = (self._place + first) % self._size
        odd = place % 2 == 1
        return [np.flatnonzero(odd), np.flatnonzero(~odd & (place < self._size - 1))]

    def _f(self, index: IntArray, heads: FloatArray) -> IntArray:
        """Return f of beetles [m] with their heads at [p, m, 2]: [p, m]."""
        start, end = np.empty((2, 2, *heads.shape))  # [edge, p, m, 2]
        start[0] = self._x.take(self._before.take(index), axis=0)
        start[1] = self._x.take(self._after.take(index), axis=0)
        end[:] = heads
        added = self._evaluator.count_added_pixels(
            start.reshape(-1, 2), end.reshape(-1, 2)
        ).reshape(2, *heads.shape[:2])
        f: IntArray = added[0] - added[1]
        return f

    def move(self, step: float, whisker: float, first: int, rng: np.random.Generator) -> None:
        """Move every beetle once by equation 2; a head goes to the best place that was probed.

        Step and whisker are shorter where edges are short, so that rings cross less often. The
        equation's second line has `step` where the right whisker stands; both are d_0 long here.
        The paper's head also moves to a worse place, this one stays.

        Args:
            step: length of the move, px.
            whisker: d_0, px.
            first: where the first turn begins.
            rng: random directions.
        """
        start, end = self._edges()
        along = np.hypot(*(end - start).T)
        room = np.minimum(1, _ROOM * np.minimum(along, along[self._before]) / step)
        angle = rng.uniform(0, np.pi, len(room)) + self._spread
        b = (room * np.exp(1j * angle)).view(np.float64).reshape(*angle.shape, 2)  # [pairs, V, 2]
        pairs = len(angle)
        places = np.empty((1 + 2 * pairs, *self._x.shape))
        places[:] = self._x
        places[1 : 1 + pairs] += whisker * b
        places[1 + pairs :] -= whisker * b
        places[1:] = self._evaluator.snap_to_grid(places[1:])
        for index in self._turns(first):
            felt, every = places.take(index, axis=1), np.arange(len(index))
            f = self._f(index, felt)
            if step != whisker:
                left, right = f[1 : 1 + pairs], f[1 + pairs :]
                best = np.minimum(left, right).argmin(0)
                direction = b[best, index] * np.sign(left - right)[best, every][:, None]
                moved = self._evaluator.snap_to_grid(self._x[index] - step * direction)[None]
                felt, f = np.concatenate([felt, moved]), np.concatenate([f, self._f(index, moved)])
            best = f.argmin(0)
            self._apart += int((f[best, every] - f[0]).sum())
            self._x[index] = felt[best, every]

    def move_until_valid(
        self, iou_floor: float, search: BeetleSearch, rng: np.random.Generator
    ) -> bool:
        """Move until the floor is kept, and return whether it is.

        Ends after n moves, or when the last moves show that the floor will not be reached.
        """
        ious = [self.approximate_iou()]
        for k, step in enumerate(search.steps):
            if ious[-1] >= iou_floor and self.iou() >= iou_floor:
                return True
            # the next moves gain less than the last two
            if k > 1 and 2 * ious[-1] - ious[-3] < iou_floor:
                return False
            self.move(step, step / search.c, k, rng)
            ious.append(self.approximate_iou())
        return ious[-1] >= iou_floor and self.iou() >= iou_floor

    def moved(self, search: BeetleSearch, rng: np.random.Generator) -> "VertexSwarm":
        """Return a copy after n / 2 moves."""
        other = copy(self)
        other._x = self._x.copy()
        for k, step in enumerate(search.steps[::2]):
            other.move(step, step / search.c, k, rng)
        return other

    def cheapest_removals(self, most: int) -> list[tuple[IntArray, int]]:
        """Return the vertices to drop, the cheapest first, and what each adds to the sum.

        They are dropped one by one. Triangles are dropped as a whole, unless they are an outer ring
        with holes or the last outer ring.
        """
        start, end = self._edges()
        ends = np.cumsum(self._sizes)
        around, across = self._evaluator.count_added_pixels(
            np.concatenate([start, start[self._before]]), np.concatenate([end, end])
        ).reshape(2, -1)
        missed = (across - around - around[self._before]).astype(np.float64)
        for ring in np.flatnonzero(self._sizes == 3).tolist():
            first = ends[ring] - 3
            missed[first : first + 3] = (
                -around[first : first + 3].sum() / 3 if self._is_removable(ring) else np.inf
            )
            missed[first + 1 : first + 3] = np.inf
        order = np.argsort(missed, kind="stable")[:most]
        counts = np.where(self._size[order] == 3, 3, 1)
        return [
            (np.arange(i, i + count), round(count * missed[i]))
            for i, count in zip(order.tolist(), counts.tolist(), strict=True)
            if np.isfinite(missed[i])
        ]

    def joint_removals(self, count: int) -> list[tuple[IntArray, int]]:
        """Return `count` vertices to drop together, and what that adds to the sum; none if too few.

        They are the cheapest ones without neighbors among them.
        """
        chosen: list[int] = []
        total, near = 0, set[int]()
        for (first, *_), added in self.cheapest_removals(2 * count):
            i = int(first)
            if self._size[i] >= _LONG and i not in near:
                chosen.append(i)
                total += added
                near |= {int(self._before[i]), int(self._after[i])}
            if len(chosen) == count:
                return [(np.sort(chosen), total)]
        return []

    def _is_removable(self, ring: int) -> bool:
        """Return whether a ring may be dropped as a whole."""
        owner = self._owner
        if ring and owner[ring - 1] == owner[ring]:
            return True
        return owner[0] != owner[-1] and not (
            ring + 1 < len(owner) and owner[ring + 1] == owner[ring]
        )

    def without(self, dropped: IntArray, added: int) -> "VertexSwarm":
        """Return a copy without some vertices, and without rings that have none left.

        added: what that adds to the sum, as `cheapest_removals` gives it.
        """
        fewer = copy(self)
        sizes = self._sizes - np.bincount(
            np.searchsorted(np.cumsum(self._sizes), dropped, "right"), minlength=len(self._sizes)
        )
        kept = sizes > 0
        fewer._sizes, fewer._owner = sizes[kept], self._owner[kept]
        stays = np.ones(len(self._x), np.bool_)
        stays[dropped] = False
        fewer._x = self._x[stays]
        fewer._link()
        fewer._apart += added
        return fewer

    def iou(self) -> float:
        """Return the IoU with the outline, 0..1."""
        return self._evaluator.iou_of_edges(*self._edges())

    def approximate_iou(self) -> float:
        """Return the IoU from the sum of f and the rings' areas, in a fifth of the time."""
        start, end = self._edges()
        twice = float(np.vdot(start[:, 0], end[:, 1]) - np.vdot(start[:, 1], end[:, 0]))
        return self._evaluator.approximate_iou(abs(twice) / 2, self._apart)

    def polygons(self) -> list[Polygon]:
        """Return the polygons of all rings."""
        parts: dict[int, list[FloatArray]] = {}
        ends = np.cumsum(self._sizes).tolist()
        for owner, start, end in zip(self._owner.tolist(), [0, *ends], ends, strict=False):
            parts.setdefault(owner, []).append(self._x[start:end])
        return [Polygon(outer, tuple(holes)) for outer, *holes in parts.values()]
