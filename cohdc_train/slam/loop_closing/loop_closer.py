"""Loop closing (paper section 2.3): recognize a place, verify it, and distribute the drift."""

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
from cohdc_train.slam.loop_closing.verification import (
    LoopConstraint,
    LoopVerifier,
    LoopVerifierConfig,
)
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.local_bundle_adjustment import adjust_window
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.mapping.map_points import fuse_into
from cohdc_train.slam.optimization.pose_graph import Edges, optimize_graph
from cohdc_train.slam.optimization.reprojection import ReprojectionModel

IntArray = NDArray[np.int64]
_SHARED_RANGE = (10, 400)  # shared points that the weight of an edge follows


@dataclass(frozen=True)
class LoopCloserConfig:
    """Options of a loop closer.

    Attributes:
        loops: candidates and pose graph.
        verification: of candidates.
        matching: of points with keypoints.
        ransac: pose of a candidate.
        bundle_adjustment: after the loop is closed.
    """

    loops: LoopConfig = LoopConfig()
    verification: LoopVerificationConfig = LoopVerificationConfig()
    matching: MatchingConfig = MatchingConfig()
    ransac: RansacConfig = RansacConfig()
    bundle_adjustment: BundleAdjustmentConfig = BundleAdjustmentConfig()


class LoopCloser:
    """Closer of loops among the keyframes of a map.

    Attributes:
        closed: number of loops closed so far.
        image_px: longer side of the images that `close` takes, px.
    """

    def __init__(
        self,
        point_map: Map,
        reprojection: ReprojectionModel,
        config: LoopCloserConfig = LoopCloserConfig(),
        seed: int = 0,
    ) -> None:
        """Start without loops. seed: of all random samples."""
        self.closed = 0
        self.image_px = config.verification.image_px
        self._map = point_map
        self._reprojection = reprojection
        self._config = config.loops
        self._bundle_adjustment = config.bundle_adjustment
        self._places = PlaceRecognizer(config.loops, seed)
        self._images: dict[int, DepthImage] = {}  # of the keyframes in the map, by index
        self._loops: list[LoopConstraint] = []
        verifier_config = LoopVerifierConfig(config.verification, config.matching, config.ransac)
        rng = np.random.default_rng(seed)
        self._verifier = LoopVerifier(point_map, reprojection, verifier_config, rng)

    def close(self, keyframe: Keyframe, image: DepthImage) -> None:
        """Look for a loop with the newest keyframe, and close it.

        Must be called once for each keyframe, after it was inserted. Where a loop is closed, all
        poses and points of the map move.

        Args:
            keyframe: the newest in the map.
            image: of the keyframe.
        """
        self._images[keyframe.index] = image
        candidates = self._find_candidates(keyframe)
        self._places.add(keyframe.index, keyframe.features.descriptors)
        for old in candidates:
            loop = self._verifier.verify(keyframe, old, self._images)
            if loop is not None and self._correct_map(loop):
                self._fuse_points(loop)
                self.closed += 1
                return

    def forget(self, keyframe: Keyframe) -> None:
        """Forget a keyframe that was removed from the map; not one of `loop_keyframes`."""
        del self._images[keyframe.index]
        self._places.remove(keyframe.index)

    @property
    def loop_keyframes(self) -> set[int]:
        """Indices of the keyframes that closed loops refer to."""
        return {index for loop in self._loops for index in (loop.old, *loop.new.tolist())}

    def _find_candidates(self, keyframe: Keyframe) -> list[Keyframe]:
        """Find old keyframes that look like this one and share few points with it."""
        config = self._config
        keyframes = self._map.keyframes[:-1]
        if len(keyframes) <= config.min_gap_keyframes:
            return []
        similarity = self._places.similarity(keyframe.features.descriptors)
        num_shared = self._map.shared(keyframe.observed_point_ids(), keyframes)

        # Neighbors are no loop, but a loop must look as similar as they do.
        is_neighbor = num_shared >= config.covisible_points
        threshold = 0.0
        if is_neighbor.any():
            threshold = config.min_similarity_ratio * float(np.median(similarity[is_neighbor]))
        similarity[is_neighbor] = 0.0
        similarity[-config.min_gap_keyframes :] = 0.0

        found: list[int] = []
        for place in np.argsort(-similarity, kind="stable").tolist():
            if similarity[place] <= threshold or len(found) == config.candidates:
                break
            if all(abs(place - other) >= config.candidate_spacing for other in found):
                found.append(place)
        return [keyframes[place] for place in found]

    def _correct_map(self, loop: LoopConstraint) -> bool:
        """Optimize the pose graph with a new loop, and move the map.

        Returns:
            False where the graph rejects the loop as an outlier; then nothing has moved.
        """
        edges = self._build_edges(loop)
        poses = np.stack([keyframe.T_cw for keyframe in self._map.keyframes])
        corrected, weights = optimize_graph(poses, edges, self._config)
        if weights[-len(loop.new)] < self._config.min_edge_weight:
            return False
        self._loops.append(loop)
        self._map.move(corrected)
        return True

    def _build_edges(self, newest: LoopConstraint) -> Edges:
        """Build the edges of the pose graph: neighbors, then all loops; the newest loop is last."""
        config = self._config
        poses = np.stack([keyframe.T_cw for keyframe in self._map.keyframes])
        first, second, num_shared = _neighbor_pairs(_count_shared_points(self._map), config)
        loops = [*self._loops, newest]
        row = {keyframe.index: i for i, keyframe in enumerate(self._map.keyframes)}
        old = np.concatenate([np.full(len(loop.new), row[loop.old]) for loop in loops])
        new = np.array([row[index] for loop in loops for index in loop.new.tolist()])

        # The more points two keyframes share, the better their relative pose is known.
        scale = np.sqrt(config.edge_points / np.clip(num_shared, *_SHARED_RANGE))
        neighbor_T = poses[second] @ inverse(poses[first])
        num_edges = len(first) + len(old)
        return Edges(
            first=np.concatenate([first, old]),
            second=np.concatenate([second, new]),
            T=np.concatenate([neighbor_T, *(loop.T for loop in loops)]),
            sigmas=np.outer(np.concatenate([scale, np.ones(len(old))]), config.edge_sigma),
            robust=np.arange(num_edges) >= len(first),
        )

    def _fuse_points(self, loop: LoopConstraint) -> None:
        """Fuse the points that both sides of a loop observe, and adjust the newest keyframes."""
        point_map, limit = self._map, self._config.fuse_keyframes
        newest = point_map.keyframes[-1]
        old_side = point_map.covisible(point_map.anchor(loop.old)[0].observed_point_ids(), limit)
        for keyframe in point_map.covisible(newest.observed_point_ids(), limit):
            fuse_into(point_map, point_map.points_of(old_side), keyframe, point_map.keyframes)
        adjust_window(point_map, newest, self._reprojection, self._bundle_adjustment)


def _count_shared_points(point_map: Map) -> IntArray:
    """Count the points that each two keyframes share: [k, k]."""
    observed = [keyframe.observed_point_ids() for keyframe in point_map.keyframes]
    row_starts = np.concatenate([[0], np.cumsum([len(ids) for ids in observed])])
    ones = np.ones(int(row_starts[-1]), dtype=np.int64)
    shape = (len(observed), point_map.size)
    incidence = sparse.csr_matrix((ones, np.concatenate(observed), row_starts), shape=shape)
    return np.asarray((incidence @ incidence.T).toarray(), dtype=np.int64)


def _neighbor_pairs(
    num_shared: IntArray, config: LoopConfig
) -> tuple[IntArray, IntArray, IntArray]:
    """Select the pairs of keyframes that the pose graph connects.

    Each keyframe is connected with the one before it and with its strongest neighbors of long ago.
    Those in between would repeat what the chain tells, and stiffen it against the loop.

    Args:
        num_shared: [k, k] points that each two keyframes share.
        config: size of the graph.

    Returns:
        Rows of the older and of the newer keyframe [e], and the points they share [e].
    """
    pairs = []
    for new in range(1, len(num_shared)):
        num_old = max(new - config.min_gap_keyframes, 0)
        order = np.argsort(-num_shared[new, :num_old], kind="stable")
        strongest = order[: config.graph_neighbors]
        old = [int(row) for row in strongest if num_shared[new, row] >= config.covisible_points]
        if num_shared[new, new - 1] >= config.covisible_points or not old:
            old.append(new - 1)
        pairs += [(row, new) for row in old]
    first, second = np.array(pairs).T
    return first, second, num_shared[first, second]
