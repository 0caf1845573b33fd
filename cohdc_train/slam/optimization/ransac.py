"""RANSAC pose from 3D-3D matches, with inliers decided by reprojection error and depth."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import RansacConfig
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.optimization.reprojection import MIN_DEPTH_M, Observations
from cohdc_train.trajectory.metrics import nearest_rotation


def rigid_transforms(source: Array, target: Array) -> Array:
    """Estimate rigid transforms between corresponding points (Kabsch).

    Args:
        source: [h, k, 3] m.
        target: [h, k, 3] m.

    Returns:
        [h, 4, 4] T with target ~ T source.
    """
    from_mean, to_mean = source.mean(axis=1), target.mean(axis=1)
    covariance = (target - to_mean[:, None]).transpose(0, 2, 1) @ (source - from_mean[:, None])
    result = np.zeros((len(source), 4, 4))
    result[:, :3, :3] = nearest_rotation(covariance)
    result[:, :3, 3] = to_mean - np.einsum("hij,hj->hi", result[:, :3, :3], from_mean)
    result[:, 3, 3] = 1.0
    return result


def ransac_pose(
    points: Array,
    observations: Observations,
    camera: Camera,
    rng: np.random.Generator,
    config: RansacConfig,
    hypotheses: int | None = None,
    guess: Array | None = None,
) -> tuple[Array, NDArray[np.bool_]] | None:
    """Estimate the pose on which most matches agree.

    Args:
        points: [m, 3] world, m.
        observations: the m measurements of these points.
        camera: intrinsics.
        rng: source of the random triples.
        config: limits of an inlier.
        hypotheses: number of triples, in place of config.hypotheses.
        guess: [4, 4] T_cw that competes with the random hypotheses.

    Returns:
        T_cw [4, 4] and [m] bool, True = inlier; None with fewer than three matches that have depth
        and without a guess.
    """
    count = config.hypotheses if hypotheses is None else hypotheses
    poses = [] if guess is None else [guess[None]]
    with_depth = np.flatnonzero(~np.isnan(observations.depths))
    if len(with_depth) >= 3:
        # A triple may contain a match twice; it is rare, and gets few inliers.
        triples = with_depth[rng.integers(0, len(with_depth), (count, 3))]
        local = camera.backproject(observations.pixels, observations.depths)
        poses.append(rigid_transforms(points[triples], local[triples]))
    if not poses:
        return None
    candidates = np.concatenate(poses)
    is_inlier = _inliers(candidates, points, observations, camera, config)
    best = int(np.argmax(is_inlier.sum(axis=1)))
    return candidates[best], is_inlier[best]


def _inliers(
    poses: Array, points: Array, observations: Observations, camera: Camera, config: RansacConfig
) -> NDArray[np.bool_]:
    """Return [h, m] bool, True = the match agrees with the pose in pixels and in depth."""
    rotated = (poses[:, :3, :3].reshape(-1, 3) @ points.T).reshape(len(poses), 3, -1)
    x, y, depth = (rotated + poses[:, :3, 3:]).transpose(1, 0, 2)
    z = np.maximum(depth, MIN_DEPTH_M)
    error_u = camera.fx * x / z + (camera.cx - observations.pixels[:, 0])
    error_v = camera.fy * y / z + (camera.cy - observations.pixels[:, 1])
    is_inlier = error_u**2 + error_v**2 <= (config.max_reprojection_px * observations.sigmas) ** 2
    # The comparison is False for a depth of nan, which thus passes.
    is_inlier &= ~(np.abs(depth - observations.depths) > config.max_depth_ratio * z)
    return np.asarray(is_inlier & (depth > MIN_DEPTH_M))
