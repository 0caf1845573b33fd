"""A pose from matches of which many may be wrong: random triples of 3D-3D matches, judged by
reprojection.
"""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import RansacConfig
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.optimization.reprojection import MIN_DEPTH_M, Observations
from cohdc_train.trajectory.metrics import nearest_rotation


def rigid_transforms(source: Array, target: Array) -> Array:
    """source, target: [h, k, 3] corresponding points, m. Returns [h, 4, 4] with target ~ T source
    (Kabsch).
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
    seen: Observations,
    camera: Camera,
    rng: np.random.Generator,
    config: RansacConfig,
    hypotheses: int | None = None,
    guess: Array | None = None,
) -> tuple[Array, NDArray[np.bool_]] | None:
    """The pose most matches agree with.

    points: [m, 3] world, m; seen: what the camera measured of them; guess: [4, 4] T_cw that
    competes with the random hypotheses; hypotheses: in place of config.hypotheses. Returns T_cw and
    [m] bool, True = agrees; None with fewer than three matches that have depth and no guess.
    """
    count = config.hypotheses if hypotheses is None else hypotheses
    poses = [] if guess is None else [guess[None]]
    with_depth = np.flatnonzero(~np.isnan(seen.depths))
    if len(with_depth) >= 3:
        # A triple that has one match twice fits no other: it loses, and is rare.
        triples = with_depth[rng.integers(0, len(with_depth), (count, 3))]
        local = camera.backproject(seen.pixels, seen.depths)
        poses.append(rigid_transforms(points[triples], local[triples]))
    if not poses:
        return None
    candidates = np.concatenate(poses)
    agree = _agreement(candidates, points, seen, camera, config)
    best = int(np.argmax(agree.sum(axis=1)))
    return candidates[best], agree[best]


def _agreement(
    poses: Array, points: Array, seen: Observations, camera: Camera, config: RansacConfig
) -> NDArray[np.bool_]:
    """[h, m] whether a match agrees with a hypothesis, in pixels and, where measured, in depth."""
    turned = (poses[:, :3, :3].reshape(-1, 3) @ points.T).reshape(len(poses), 3, -1)
    x, y, depth = (turned + poses[:, :3, 3:]).transpose(1, 0, 2)
    z = np.maximum(depth, MIN_DEPTH_M)
    error_u = camera.fx * x / z + (camera.cx - seen.pixels[:, 0])
    error_v = camera.fy * y / z + (camera.cy - seen.pixels[:, 1])
    agree = error_u**2 + error_v**2 <= (config.max_reprojection_px * seen.sigmas) ** 2
    # A depth of nan disagrees with nothing.
    agree &= ~(np.abs(depth - seen.depths) > config.max_depth_ratio * z)
    return np.asarray(agree & (depth > MIN_DEPTH_M))
