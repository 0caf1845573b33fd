"""Groups of points that do not move with the rest, found before they drag the pose along.

A near thing that begins to move slowly takes the pose with it: its few points fix the camera's
position better than a far wall's many, which a small turn reconciles, so that no single residual
stands out. Every group is therefore judged by a pose that was found without it. What lies further
from there than that pose's own uncertainty and the noise of measurement allow, moves. The poses of
all groups come from sums of the same normal equations.

Which of two groups that move against each other is the world, points that have long been known
decide: a person near the camera may hold most of the points, but has only come into view.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import linkage

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

_PATCHES = 24  # of neighbouring points: the leaves of the tree of groups
_LEAST = 8  # points of a group that is judged: fewer than ten near ones have carried the pose along
_MOST = 0.6  # of all points, each as often as frames have found it: a larger group is the world
_KNOWN = 30  # frames; a point that more have found counts no more
_LIMIT = 16.0  # median squared distance, in standard deviations, from which a group moves
_CLEARLY = 4.0  # times the limit: moving further counts no more than this
_ROUNDS = 4  # groups taken out, one after the other


def estimate_static_pose(
    T_cw: Array,
    points: Array,
    seen: Observations,
    reprojection: ReprojectionModel,
    found: NDArray[np.int64],
    prior: Prior | None = None,
) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """The pose from the points that hold together, after those that move as groups were taken out.

    T_cw: [4, 4] pose from all points; points: [m, 3] world, m; found: [m] frames that have found
    each, 1 and more;
    prior: where the camera was expected, which counts in poses, though not in how far a group may
    lie off. Returns the pose, [m] bool inliers and [m] bool members of moving groups.
    """
    moving = np.zeros(len(points), dtype=np.bool_)
    T_cw, inlier = optimize_pose(T_cw, points, seen, reprojection, prior=prior)
    for _ in range(_ROUNDS):
        rest = np.flatnonzero(~moving)
        group = find_moving_cluster(T_cw, points[rest], seen.take(rest), reprojection, found[rest])
        if not group.any():
            break
        moving[rest[group]] = True
        rest = np.flatnonzero(~moving)
        T_cw, agrees = optimize_pose(T_cw, points[rest], seen.take(rest), reprojection, prior=prior)
        inlier = np.zeros(len(points), dtype=np.bool_)
        inlier[rest[agrees]] = True
    return T_cw, inlier, moving


def find_moving_cluster(
    T_cw: Array,
    points: Array,
    seen: Observations,
    reprojection: ReprojectionModel,
    found: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """The group that most clearly moves against the rest.

    T_cw: [4, 4] best pose of all; points: [m, 3] world, m; found: [m] frames that have found each,
    1 and more. Returns [m] bool, all False where everything holds together.
    """
    nothing = np.zeros(len(points), dtype=np.bool_)
    if len(points) < 3 * _LEAST:
        return nothing
    local = to_local(T_cw, points)
    groups = nested_clusters(local, np.minimum(found, _KNOWN))
    error = residuals(local, seen, reprojection)
    J = pose_jacobian(local, residual_jacobian(local, seen, reprojection))
    steps, covariances = _poses_without(groups, J, error, seen.limits)
    best, score = nothing, 0.0
    for row in np.flatnonzero(_may_move(groups, J, error, steps)):
        group = groups[row]
        by_pose = J[group]
        off = error[group] + by_pose @ steps[row]
        spread = np.eye(3) + by_pose @ covariances[row] @ by_pose.transpose(0, 2, 1)
        squares = np.einsum("mi,mi->m", off, np.linalg.solve(spread, off[..., None])[..., 0])
        excess = float(np.median(squares)) / _LIMIT
        if excess > 1 and len(off) * min(excess, _CLEARLY) > score:
            best, score = group, len(off) * min(excess, _CLEARLY)
    return best


def _may_move(groups: NDArray[np.bool_], J: Array, error: Array, steps: Array) -> NDArray[np.bool_]:
    """[g] False where over half of a group lies within the limit even of a pose that is certain.

    The pose's own uncertainty only makes less of a distance, so the exact test is spared.
    """
    off = error[..., None] + (J.reshape(-1, 6) @ steps.T).reshape(*error.shape, -1)
    squares = off[:, 0] ** 2 + off[:, 1] ** 2 + off[:, 2] ** 2
    within = np.count_nonzero((squares <= _LIMIT) & groups.T, axis=0)
    return np.asarray(2 * within <= groups.sum(axis=1))


def _poses_without(
    groups: NDArray[np.bool_], J: Array, error: Array, limits: Array
) -> tuple[Array, Array]:
    """What each group's leaving would move the pose by, [g, 6], and the covariance of that pose,
    [g, 6, 6].
    """
    weight = huber_weights(np.einsum("mi,mi->m", error, error), limits)
    weighted = J * weight[:, None, None]
    H = (weighted.transpose(0, 2, 1) @ J).reshape(-1, 36)
    g = np.einsum("mra,mr->ma", weighted, error)
    share = groups.astype(np.float64)
    covariances = np.linalg.inv((H.sum(axis=0) - share @ H).reshape(-1, 6, 6) + 1e-6 * np.eye(6))
    return -np.einsum("gab,gb->ga", covariances, g.sum(axis=0) - share @ g), covariances


def nested_clusters(local: Array, counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[g, m] bool: patches of neighbouring points [m, 3] m, and their unions up a tree; those of a
    judgeable size.

    counts: [m] for how many each point counts when the world is sought.
    """
    patches, centers = _patches(local)
    groups = list(patches)
    if len(groups) > 1:
        for first, second, _, _ in linkage(centers, "average"):
            groups.append(groups[int(first)] | groups[int(second)])
    members = np.stack(groups)
    size = members.sum(axis=1)
    may_move = (members @ counts <= _MOST * counts.sum()) & (len(local) - size >= _LEAST)
    return np.asarray(members[(size >= _LEAST) & may_move])


def _patches(local: Array) -> tuple[NDArray[np.bool_], Array]:
    """Points by the nearest of a few that lie far apart: [p, m] bool, and the patches' middles [p,
    3] m.
    """
    x, y, z = np.ascontiguousarray(local.T)
    middle = int(np.argmin(z))
    distance, nearest = np.full(len(local), np.inf), np.zeros(len(local), dtype=np.int64)
    for patch in range(min(_PATCHES, len(local))):
        square = (x - x[middle]) ** 2 + (y - y[middle]) ** 2 + (z - z[middle]) ** 2
        nearest[square < distance] = patch
        np.minimum(distance, square, out=distance)
        middle = int(np.argmax(distance))
    patches = nearest[None] == np.unique(nearest)[:, None]
    return patches, (patches @ local) / patches.sum(axis=1)[:, None]
