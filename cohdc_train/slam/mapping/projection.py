"""Projection of map points into a camera, with the visibility tests of ORB-SLAM2."""

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.matching import Projected
from cohdc_train.slam.geometry.se3 import Array, to_local
from cohdc_train.slam.mapping.map import Map


def project_points(point_map: Map, ids: NDArray[np.int64], T_cw: Array) -> Projected:
    """Project the points that a camera at a pose should observe.

    A point must lie in the image, be seen from a similar direction as before, and at a distance at
    which a level of the pyramid shows it.

    Args:
        point_map: the map.
        ids: [n] points.
        T_cw: [4, 4] world to camera, m.
    """
    camera, local = point_map.camera, to_local(T_cw, point_map.positions[ids])
    near, num_levels = point_map.config.min_depth_m, point_map.pyramid.num_levels
    z = np.maximum(local[:, 2], near)
    u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
    inside = (local[:, 2] > near) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    ids, local = ids[inside], local[inside]
    distance = np.sqrt(np.einsum("nj,nj->n", local, local))
    sums = point_map.directions[ids]
    # The cosine of the view angle, times distance and length of the sum.
    along = np.einsum("nj,nj->n", local @ T_cw[:3, :3], sums)
    max_distance = np.maximum(point_map.max_distance_m[ids], 1e-9)
    level = np.log(max_distance / distance) / np.log(point_map.pyramid.factor)
    length = np.sqrt(np.einsum("nj,nj->n", sums, sums))
    is_visible = along > point_map.matching.min_view_cosine * distance * length
    is_visible &= (level > -1.0) & (level < num_levels)
    levels = np.clip(np.rint(level[is_visible]), 0, num_levels - 1).astype(np.int64)
    pixels = np.stack([u[inside][is_visible], v[inside][is_visible]], axis=1)
    ids = ids[is_visible]
    return Projected(ids, pixels, levels, point_map.descriptors[ids])
