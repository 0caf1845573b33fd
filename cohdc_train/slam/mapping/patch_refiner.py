"""Photometric refinement: a measurement moves to where the point's patch fits best (paper eqs. 8
and 9).

A corner of ORB lies on a whole pixel of its pyramid level. The patch that was cut out where the
point was first seen, turned and scaled as the camera has moved since, says where in the image the
point is to a fraction of that. Such measurements are `is_subpixel` and weigh accordingly, in a
frame's pose as in bundle adjustment. We depart from eq. 9 in that A has four free entries: the
patch is taken for a plane that faced the first camera.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import RefinementConfig
from cohdc_train.slam.features.keypoints import Features
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.features.patch_alignment import Pyramid, align, warp_patches
from cohdc_train.slam.geometry.se3 import Array, to_local
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map


class PatchRefiner:
    """Patches of a map's points, and the refinement of matched keypoints by them.

    Points of the coarsest keypoints have no patch.
    """

    def __init__(self, point_map: Map, config: RefinementConfig) -> None:
        self._map = point_map
        self._config = config
        self._patches = np.zeros((0, config.patch_px, config.patch_px), dtype=np.uint8)
        self._octaves = np.zeros(0, dtype=np.int64)

    def pyramid(self, gray: NDArray[np.uint8]) -> Pyramid:
        """Return the image pyramid of a frame [H, W] that `store` and `refine` take."""
        scale = self._map.pyramid
        return Pyramid(gray, scale, min(self._config.max_level, scale.num_levels - 1))

    def store(self, keyframe: Keyframe, pyramid: Pyramid) -> None:
        """Store the patches of the points created in a keyframe, the newest in the map.

        pyramid: of the keyframe's image. The keypoints of these points are marked as refined.
        """
        self._reserve(len(self._map.positions))
        side = self._config.patch_px
        first_keyframe = self._map.first_keyframe
        # Blank, or a point without a patch would have that of the point whose row it took.
        self._patches[first_keyframe[: len(self._patches)] == keyframe.index] = 0

        is_fine = keyframe.features.octaves <= self._config.max_level
        keypoints = np.flatnonzero((keyframe.point_ids >= 0) & is_fine)
        is_new = first_keyframe[keyframe.point_ids[keypoints]] == keyframe.index
        keypoints = keypoints[is_new]
        ids, octaves = keyframe.point_ids[keypoints], keyframe.features.octaves[keypoints]
        patches = pyramid.cut(keyframe.features.pixels[keypoints], octaves, side)
        self._patches[ids] = np.rint(patches).reshape(-1, side, side)
        self._octaves[ids] = octaves
        keyframe.features = keyframe.features.marked_subpixel(keypoints, True)

    def refine(
        self, features: Features, matches: Matches, T_cw: Array, pyramid: Pyramid
    ) -> Features:
        """Return the features with matched keypoints moved to where their patches fit better.

        T_cw: [4, 4] the frame's pose; pyramid: of the frame's image.
        """
        matches = matches.take(features.octaves[matches.keypoints] <= self._config.max_level)
        if len(matches) == 0:
            return features
        ids, keypoints = matches.point_ids, matches.keypoints
        octaves, scale = features.octaves[keypoints], self._map.pyramid
        A = affine(self._map, ids, T_cw)
        back = np.linalg.inv(A) * scale.scales(octaves - self._octaves[ids])[:, None, None]
        template = warp_patches(self._patches[ids], back, self._config.template_px + 2)
        shift, good = align(pyramid, features.pixels[keypoints], octaves, template, self._config)
        rows = keypoints[good]
        pixels, undistorted = features.pixels.copy(), features.undistorted.copy()
        pixels[rows] += shift[good] * scale.scales(octaves[good, None])
        # The difference, for points may be corrected for the rolling shutter.
        undistort = self._map.camera.undistort
        undistorted[rows] += undistort(pixels[rows]) - undistort(features.pixels[rows])
        is_subpixel = np.zeros(len(features), dtype=np.bool_)
        is_subpixel[rows] = True
        return replace(features, pixels=pixels, undistorted=undistorted, is_subpixel=is_subpixel)

    def _reserve(self, count: int) -> None:
        """Make room for as many points as the map has, which doubles its arrays."""
        grown = count - len(self._patches)
        if grown > 0:
            blank = np.zeros((grown, *self._patches.shape[1:]), dtype=np.uint8)
            self._patches = np.concatenate([self._patches, blank])
            self._octaves = np.concatenate([self._octaves, np.zeros(grown, dtype=np.int64)])


def affine(point_map: Map, ids: NDArray[np.int64], T_cw: Array) -> Array:
    """A of eq. 9 for n points: [n, 2, 2] px of a camera at T_cw per px of the keyframe where each
    was first seen.
    """
    camera, points = point_map.camera, point_map.positions[ids]
    first_keyframe, which = np.unique(point_map.first_keyframe[ids], return_inverse=True)
    T_bw = np.stack([point_map.pose(index) for index in first_keyframe.tolist()])[which]
    depth = (
        np.einsum("nj,nj->n", T_bw[:, 2, :3], points) + T_bw[:, 2, 3]
    )  # in the keyframe of its birth
    local = to_local(T_cw, points)
    across = T_cw[:3, :3] @ T_bw[:, :2, :3].transpose(
        0, 2, 1
    )  # [n, 3, 2] that keyframe's x and y axes
    across *= (depth[:, None] / np.array([camera.fx, camera.fy]))[:, None]  # m per px
    A: Array = across[:, :2] - (local[:, :2] / local[:, 2:])[:, :, None] * across[:, 2:]
    A *= np.array([camera.fx, camera.fy])[:, None] / local[:, 2, None, None]
    return A
