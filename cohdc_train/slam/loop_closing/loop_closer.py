"""Loop closing (paper section 2.3): a place seen before is recognised and checked, the drift since
is spread out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cohdc_train.slam.config import (
    BundleAdjustmentConfig,
    LoopConfig,
    LoopVerificationConfig,
    MatchingConfig,
    RansacConfig,
)
from cohdc_train.slam.geometry.depth_image import DepthImage
from cohdc_train.slam.geometry.se3 import inverse
from cohdc_train.slam.loop_closing.place_recognition import PlaceRecognizer
from cohdc_train.slam.loop_closing.verification import LoopConstraint, LoopVerifier
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.local_bundle_adjustment import adjust_window
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.map_points import fuse_into
from cohdc_train.slam.optimization.pose_graph import Edges, optimize_graph
from cohdc_train.slam.optimization.reprojection import ReprojectionModel

_RECENT = 10  # keyframes that cannot be a loop with the newest
_COVISIBLE = 15  # shared points make neighbours, and neighbours are no loop
_CANDIDATES = 2  # checked per keyframe
_LIKENESS = 0.7  # of the likeness of the keyframe's neighbours, which an old keyframe must reach
_APART = 5  # keyframes between two candidates: nearer ones are the same place
_FUSE = 6  # keyframes on each side whose points are made one
_STRONG = 3  # older neighbours of a keyframe that the graph knows besides the one before it
_SIGMA = (0.01, 0.003)  # m, rad: of a relative pose between keyframes that share _SHARED points
_SHARED = 100
_TRUST = 0.3  # weight that the graph must leave to a new loop


@dataclass(frozen=True)
class LoopCloserConfig:
    """Options of a loop closer."""

    loops: LoopConfig = LoopConfig()
    verification: LoopVerificationConfig = LoopVerificationConfig()
    matching: MatchingConfig = MatchingConfig()
    ransac: RansacConfig = RansacConfig()
    bundle_adjustment: BundleAdjustmentConfig = BundleAdjustmentConfig()


class LoopCloser:
    """Watches the keyframes of a map; `closed` counts the loops closed."""

    def __init__(
        self,
        world: Map,
        reprojection: ReprojectionModel,
        config: LoopCloserConfig = LoopCloserConfig(),
        seed: int = 0,
    ) -> None:
        self.closed = 0
        self._world, self._reprojection = world, reprojection
        self._config = config
        self._places = PlaceRecognizer(seed)
        self._pictures: dict[int, DepthImage] = {}  # of the keyframes in the map, by index
        self._loops: list[LoopConstraint] = []
        self._verify = LoopVerifier(
            world, reprojection, np.random.default_rng(seed), config.matching, config.ransac
        )

    def close(self, keyframe: Keyframe, picture: DepthImage) -> bool:
        """Look for a loop with the newest keyframe of the map; every one must be given once, when
        it has joined.

        Where one is found, all poses and points of the map move; returns whether that happened.
        """
        self._pictures[keyframe.index] = picture
        candidates = self._candidates(keyframe)
        self._places.add(keyframe.index, keyframe.features.descriptors)
        for old in candidates:
            loop = self._verify(keyframe, old, self._pictures)
            if loop is not None and self._correct(loop):
                self._join(loop)
                self.closed += 1
                return True
        return False

    def forget(self, keyframe: Keyframe) -> None:
        """The map gave up a keyframe, which must not be one of `ends`."""
        del self._pictures[keyframe.index]
        self._places.remove(keyframe.index)

    @property
    def loop_keyframes(self) -> set[int]:
        """Indices of the keyframes that loops hold on to."""
        return {index for loop in self._loops for index in (loop.old, *loop.new.tolist())}

    def _candidates(self, keyframe: Keyframe) -> list[Keyframe]:
        """Old keyframes that look like this one and share next to nothing with it."""
        keyframes = self._world.keyframes[:-1]
        if len(keyframes) <= _RECENT:
            return []
        similarity = self._places.similarity(keyframe.features.descriptors)
        shared = self._world.shared(keyframe.seen_points(), keyframes)
        near = shared >= _COVISIBLE
        least = _LIKENESS * float(np.median(similarity[near])) if near.any() else 0.0
        similarity[near] = 0.0
        similarity[-_RECENT:] = 0.0
        found: list[int] = []
        for place in np.argsort(-similarity, kind="stable").tolist():
            if similarity[place] <= least or len(found) == _CANDIDATES:
                break
            if all(abs(place - other) >= _APART for other in found):
                found.append(place)
        return [keyframes[place] for place in found]

    def _correct(self, loop: LoopConstraint) -> bool:
        """Optimise the graph with the new loop and move the map, unless the graph refuses the loop."""
        edges = self._edges(loop)
        before = np.stack([k.T_cw for k in self._world.keyframes])
        after, weights = optimize_graph(before, edges, self._config.loops)
        if weights[-len(loop.new)] < _TRUST:
            return False
        self._loops.append(loop)
        self._world.move(after)
        return True

    def _edges(self, newest: LoopConstraint) -> Edges:
        """Neighbours in time, old neighbours in view, and all loops; the newest loop comes last."""
        poses = np.stack([k.T_cw for k in self._world.keyframes])
        first, second, shared = _graph_pairs(_shared_points(self._world))
        loops = [*self._loops, newest]
        row = {keyframe.index: i for i, keyframe in enumerate(self._world.keyframes)}
        old = np.concatenate([np.full(len(loop.new), row[loop.old]) for loop in loops])
        new = np.array([row[index] for loop in loops for index in loop.new.tolist()])
        scale = np.sqrt(_SHARED / np.clip(shared, 10, 400))
        return Edges(
            np.concatenate([first, old]),
            np.concatenate([second, new]),
            np.concatenate([poses[second] @ inverse(poses[first]), *(loop.T for loop in loops)]),
            np.outer(np.concatenate([scale, np.ones(len(old))]), _SIGMA),
            np.arange(len(first) + len(old)) >= len(first),
        )

    def _join(self, loop: LoopConstraint) -> None:
        """Make the points one that both ends of the loop have, and adjust around the newest
        keyframe.
        """
        world = self._world
        keyframe = world.keyframes[-1]
        place = world.covisible(world.anchor(loop.old)[0].seen_points(), _FUSE)
        for here in world.covisible(keyframe.seen_points(), _FUSE):
            fuse_into(world, world.points_of(place), here, world.keyframes)
        adjust_window(world, keyframe, self._reprojection, self._config.bundle_adjustment)


def _shared_points(world: Map) -> NDArray[np.int64]:
    """[k, k] how many points each two keyframes share."""
    seen = [k.seen_points() for k in world.keyframes]
    loop_keyframes = np.concatenate([[0], np.cumsum([len(ids) for ids in seen])])
    ones = np.ones(int(loop_keyframes[-1]), dtype=np.int64)
    incidence = sparse.csr_matrix(
        (ones, np.concatenate(seen), loop_keyframes), shape=(len(seen), world.size)
    )
    return np.asarray((incidence @ incidence.T).toarray(), dtype=np.int64)


def _graph_pairs(
    shared: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of keyframes that the graph holds together, older first, and how many points they
    share.

    Every keyframe holds to the one before it and to its strongest neighbours of long ago. Those in
    between would repeat what the chain says already and stiffen it against the loop.
    """
    pairs = []
    for new in range(1, len(shared)):
        strong = np.argsort(-shared[new, : max(new - _RECENT, 0)], kind="stable")[:_STRONG]
        old = [int(k) for k in strong if shared[new, k] >= _COVISIBLE]
        if shared[new, new - 1] >= _COVISIBLE or not old:
            old.append(new - 1)
        pairs += [(k, new) for k in old]
    first, second = np.array(pairs).T
    return first, second, shared[first, second]
