"""Photometric refinement of keypoints by the patches of their points (paper eqs. 8 and 9).

An ORB keypoint lies at an integer pixel position of its pyramid level. The patch of the point's
first keyframe, warped by the camera motion since then, locates the point to a fraction of a pixel.
Refined measurements are marked `is_subpixel` and have a higher weight in pose optimization and
bundle adjustment. We depart from eq. 9 in that A has four free entries: the patch is assumed to be
a plane parallel to the first keyframe's image.
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
    """Patches of the map's points, and the refinement of matched keypoints by them.

    Points at coarse pyramid levels have no patch.
    """

    def __init__(self, point_map: Map, config: RefinementConfig) -> None:
        self._map = point_map
        self._config = config
        self._patches = np.zeros((0, config.patch_px, config.patch_px), dtype=np.uint8)
        self._octaves = np.zeros(0, dtype=np.int64)

    def pyramid(self, gray: NDArray[np.uint8]) -> Pyramid:
        """Return the image pyramid of a gray frame [H, W] for `store` and `refine`."""
        scale = self._map.pyramid
        return Pyramid(gray, scale, min(self._config.max_level, scale.num_levels - 1))

    def store(self, keyframe: Keyframe, pyramid: Pyramid) -> None:
        """Store the patches of the points that were created in the newest keyframe.

        The keypoints of these points are marked as refined. pyramid: of the keyframe's image.
        """
        self._reserve(len(self._map.positions))
        side = self._config.patch_px
        first_keyframe = self._map.first_keyframe
        # Clear reused rows: a point without a patch must not have that of a removed point.
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
        """Return the features with matched keypoints moved to where their patches fit best.

        T_cw: [4, 4] pose of the frame; pyramid: of the frame's image.
        """
        matches = matches.take(features.octaves[matches.keypoints] <= self._config.max_level)
        if len(matches) == 0:
            return features
        ids, keypoints = matches.point_ids, matches.keypoints
        octaves, scale = features.octaves[keypoints], self._map.pyramid
        A = affine(self._map, ids, T_cw)
        inverse = np.linalg.inv(A) * scale.scales(octaves - self._octaves[ids])[:, None, None]
        template = warp_patches(self._patches[ids], inverse, self._config.template_px + 2)
        shift, is_aligned = align(
            pyramid, features.pixels[keypoints], octaves, template, self._config
        )
        rows = keypoints[is_aligned]
        pixels, undistorted = features.pixels.copy(), features.undistorted.copy()
        pixels[rows] += shift[is_aligned] * scale.scales(octaves[is_aligned, None])
        # Add the difference, since positions may be corrected for the rolling shutter.
        undistort = self._map.camera.undistort
        undistorted[rows] += undistort(pixels[rows]) - undistort(features.pixels[rows])
        is_subpixel = np.zeros(len(features), dtype=np.bool_)
        is_subpixel[rows] = True
        return replace(features, pixels=pixels, undistorted=undistorted, is_subpixel=is_subpixel)

    def _reserve(self, count: int) -> None:
        """Grow the arrays to the number of rows of the map."""
        grown = count - len(self._patches)
        if grown > 0:
            blank = np.zeros((grown, *self._patches.shape[1:]), dtype=np.uint8)
            self._patches = np.concatenate([self._patches, blank])
            self._octaves = np.concatenate([self._octaves, np.zeros(grown, dtype=np.int64)])


def affine(point_map: Map, ids: NDArray[np.int64], T_cw: Array) -> Array:
    """Compute the affine maps A of eq. 9 for n points.

    Returns [n, 2, 2], px of a camera at T_cw per px of each point's first keyframe.
    """
    camera, points = point_map.camera, point_map.positions[ids]
    first_keyframe, which = np.unique(point_map.first_keyframe[ids], return_inverse=True)
    T_kw = np.stack([point_map.pose(index) for index in first_keyframe.tolist()])[which]
    # Depth in the point's first keyframe.
    depth = np.einsum("nj,nj->n", T_kw[:, 2, :3], points) + T_kw[:, 2, 3]
    local = to_local(T_cw, points)
    # [n, 3, 2]: x and y axis of the first keyframe in the camera frame.
    axes = T_cw[:3, :3] @ T_kw[:, :2, :3].transpose(0, 2, 1)
    axes *= (depth[:, None] / np.array([camera.fx, camera.fy]))[:, None]  # m per px
    A: Array = axes[:, :2] - (local[:, :2] / local[:, 2:])[:, :, None] * axes[:, 2:]
    A *= np.array([camera.fx, camera.fy])[:, None] / local[:, 2, None, None]
    return A
