"""Clusters of map points that move against the rest, found before they bias the pose.

A near object that begins to move slowly drags the pose along: its few points fix the camera's
position better than the many points of a far wall, which a small rotation reconciles, so that no
single residual stands out. Each cluster is therefore judged by a pose that was estimated without
it. It moves if it is farther from there than the uncertainty of that pose and the measurement noise
allow. The poses of all clusters come from sums of the same normal equations.

Of two clusters that move against each other, the one with points of long tracks is the static
world: a person near the camera may hold most of the points, but has only come into view.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import linkage

from cohdc_train.slam.config import MotionSegmentationConfig
from cohdc_train.slam.geometry.se3 import Array, to_local
from cohdc_train.slam.optimization.pose import optimize_pose
from cohdc_train.slam.optimization.reprojection import (
    Observations,
    Prior,
    ReprojectionModel,
    huber_weights,
    pose_jacobian,
    residual_jacobian,
    residuals,
)


class StaticPose(NamedTuple):
    """Pose of a frame by the points that move together with the static world.

    Attributes:
        T_cw: [4, 4] world to camera, m.
        inlier: [m] bool, True = the point agrees with the pose.
        moving: [m] bool, True = the point belongs to a moving cluster.
    """

    T_cw: Array
    inlier: NDArray[np.bool_]
    moving: NDArray[np.bool_]


class _PosesWithout(NamedTuple):
    """Poses that result when one cluster is excluded.

    steps: [g, 6] twist from the pose of all points; covariances: [g, 6, 6].
    """

    steps: Array
    covariances: Array


def estimate_static_pose(
    T_cw: Array,
    points: Array,
    observed: Observations,
    reprojection: ReprojectionModel,
    track_lengths: NDArray[np.int64],
    prior: Prior | None = None,
    config: MotionSegmentationConfig = MotionSegmentationConfig(),
) -> StaticPose:
    """Estimate the pose of a frame without the clusters of points that move.

    Args:
        T_cw: [4, 4] pose by all points, m.
        points: [m, 3] world, m.
        observed: measurements of the points.
        reprojection: error model.
        track_lengths: [m] number of frames that found each point, 1 and more.
        prior: of the pose; it has no say in which cluster moves.
        config: thresholds.
    """
    moving = np.zeros(len(points), dtype=np.bool_)
    T_cw, inlier = optimize_pose(T_cw, points, observed, reprojection, prior=prior)
    for _ in range(config.max_iterations):
        rest = np.flatnonzero(~moving)
        cluster = find_moving_cluster(
            T_cw, points[rest], observed.take(rest), reprojection, track_lengths[rest], config
        )
        if not cluster.any():
            break
        moving[rest[cluster]] = True

        rest = np.flatnonzero(~moving)
        T_cw, agrees = optimize_pose(
            T_cw, points[rest], observed.take(rest), reprojection, prior=prior
        )
        inlier = np.zeros(len(points), dtype=np.bool_)
        inlier[rest[agrees]] = True
    return StaticPose(T_cw, inlier, moving)


def find_moving_cluster(
    T_cw: Array,
    points: Array,
    observed: Observations,
    reprojection: ReprojectionModel,
    track_lengths: NDArray[np.int64],
    config: MotionSegmentationConfig = MotionSegmentationConfig(),
) -> NDArray[np.bool_]:
    """Find the cluster of points that most clearly moves against the rest.

    Args:
        T_cw: [4, 4] best pose by all points, m.
        points: [m, 3] world, m.
        observed: measurements of the points.
        reprojection: error model.
        track_lengths: [m] number of frames that found each point, 1 and more.
        config: thresholds.

    Returns:
        [m] bool, all False where nothing moves.
    """
    nothing = np.zeros(len(points), dtype=np.bool_)
    if len(points) < 3 * config.min_points:
        return nothing
    local = to_local(T_cw, points)
    clusters = nested_clusters(local, track_lengths, config)
    error = residuals(local, observed, reprojection)
    jacobian = pose_jacobian(local, residual_jacobian(local, observed, reprojection))
    poses = _poses_without(clusters, jacobian, error, observed.chi2_thresholds)

    best, best_score = nothing, 0.0
    limit = config.min_median_chi2
    for row in np.flatnonzero(_may_move(clusters, jacobian, error, poses.steps, limit)).tolist():
        cluster = clusters[row]
        chi2 = _chi2_without(error[cluster], jacobian[cluster], poses, row)
        excess = float(np.median(chi2)) / limit
        score = len(chi2) * min(excess, config.max_excess)
        if excess > 1 and score > best_score:
            best, best_score = cluster, score
    return best


def _chi2_without(error: Array, jacobian: Array, poses: _PosesWithout, row: int) -> Array:
    """Return the squared errors [k], in sigmas, of a cluster's points at the pose without it.

    The covariance sums the noise of the measurement and the uncertainty of the pose.
    """
    residual = error + jacobian @ poses.steps[row]
    covariance = np.eye(3) + jacobian @ poses.covariances[row] @ jacobian.transpose(0, 2, 1)
    whitened = np.linalg.solve(covariance, residual[..., None])[..., 0]
    return np.asarray(np.einsum("mi,mi->m", residual, whitened))


def _may_move(
    clusters: NDArray[np.bool_], jacobian: Array, error: Array, steps: Array, limit: float
) -> NDArray[np.bool_]:
    """Return False for clusters [g] that lie mostly within the limit of even an exact pose.

    The uncertainty of the pose only reduces the error, so that such a cluster needs no exact test.
    """
    shift = (jacobian.reshape(-1, 6) @ steps.T).reshape(*error.shape, -1)
    residual = error[..., None] + shift
    squares = residual[:, 0] ** 2 + residual[:, 1] ** 2 + residual[:, 2] ** 2
    num_within = np.count_nonzero((squares <= limit) & clusters.T, axis=0)
    return np.asarray(2 * num_within <= clusters.sum(axis=1))


def _poses_without(
    clusters: NDArray[np.bool_], jacobian: Array, error: Array, limits: Array
) -> _PosesWithout:
    """Solve the normal equations of all points without each cluster. limits: [m] of Huber."""
    weight = huber_weights(np.einsum("mi,mi->m", error, error), limits)
    weighted = jacobian * weight[:, None, None]
    H = (weighted.transpose(0, 2, 1) @ jacobian).reshape(-1, 36)
    g = np.einsum("mra,mr->ma", weighted, error)
    members = clusters.astype(np.float64)
    remaining_H = (H.sum(axis=0) - members @ H).reshape(-1, 6, 6)
    remaining_g = g.sum(axis=0) - members @ g
    covariances = np.linalg.inv(remaining_H + 1e-6 * np.eye(6))
    return _PosesWithout(-np.einsum("gab,gb->ga", covariances, remaining_g), covariances)


def nested_clusters(
    local: Array,
    track_lengths: NDArray[np.int64],
    config: MotionSegmentationConfig = MotionSegmentationConfig(),
) -> NDArray[np.bool_]:
    """Cluster points by distance: patches of neighbors, and their unions up a tree.

    Args:
        local: [m, 3] points in the camera frame, m.
        track_lengths: [m] number of frames that found each point; a cluster that holds too large a
            share of the tracks is the static world.
        config: sizes of clusters.

    Returns:
        [g, m] bool, the members of each cluster whose motion can be judged.
    """
    patches, centers = _patches(local, config.num_clusters)
    clusters = list(patches)
    if len(clusters) > 1:
        for first, second, _, _ in linkage(centers, "average"):
            clusters.append(clusters[int(first)] | clusters[int(second)])
    members = np.stack(clusters)
    size = members.sum(axis=1)

    counts = np.minimum(track_lengths, config.max_track_length)
    may_move = members @ counts <= config.max_ratio * counts.sum()
    may_move &= (size >= config.min_points) & (len(local) - size >= config.min_points)
    return np.asarray(members[may_move])


def _patches(local: Array, num_patches: int) -> tuple[NDArray[np.bool_], Array]:
    """Assign points to the nearest of a few seeds that lie far apart (farthest-point sampling).

    Returns:
        [p, m] bool members of each patch, and [p, 3] m centers.
    """
    x, y, z = np.ascontiguousarray(local.T)
    seed = int(np.argmin(z))
    distance, nearest = np.full(len(local), np.inf), np.zeros(len(local), dtype=np.int64)
    for patch in range(min(num_patches, len(local))):
        square = (x - x[seed]) ** 2 + (y - y[seed]) ** 2 + (z - z[seed]) ** 2
        nearest[square < distance] = patch
        np.minimum(distance, square, out=distance)
        seed = int(np.argmax(distance))
    patches = nearest[None] == np.unique(nearest)[:, None]
    return patches, (patches @ local) / patches.sum(axis=1)[:, None]
