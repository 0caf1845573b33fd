"""Photometric refinement: a measurement moves to where the point's patch fits best (paper eqs. 8
and 9).

A corner of ORB lies on a whole pixel of its pyramid level. The patch that was cut out where the
point was first seen, turned and scaled as the camera has moved since, says where in the image the
point is to a fraction of that. Such measurements are `is_subpixel` and weigh accordingly, in a
frame's pose as in bundle adjustment. We depart from eq. 9 in that A has four free entries: the
patch is taken for a plane that faced the first camera.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.keypoints import SCALE, Features
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.features.patch_alignment import (
    MAX_LEVEL,
    PATCH_PX,
    TEMPLATE_PX,
    Pyramid,
    align,
    warped,
)
from cohdc_train.slam.geometry.se3 import Array, to_local
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map


@dataclass
class PatchRefiner:
    """Keeps the patches of a map's points, of all but the coarsest corners, and moves measurements
    by them.
    """

    world: Map

    def __post_init__(self) -> None:
        self._patches = np.zeros((0, PATCH_PX, PATCH_PX), dtype=np.uint8)
        self._octaves = np.zeros(0, dtype=np.int64)
        self._pyramid: Pyramid | None = None

    def look_at(self, gray: NDArray[np.uint8]) -> None:
        """The frame that is meant from now on, [H, W]."""
        self._pyramid = Pyramid(gray)

    def remember(self, keyframe: Keyframe) -> None:
        """Cut out the points that were born in a keyframe, the newest in the map, made of the frame
        looked at.
        """
        assert self._pyramid is not None
        grown = len(self.world.positions) - len(
            self._patches
        )  # the map doubles its arrays, so this is rarely copied
        if grown > 0:
            self._patches = np.concatenate(
                [self._patches, np.zeros((grown, PATCH_PX, PATCH_PX), dtype=np.uint8)]
            )
            self._octaves = np.concatenate([self._octaves, np.zeros(grown, dtype=np.int64)])
        first_keyframe = np.flatnonzero(
            self.world.first_keyframe[: len(self._patches)] == keyframe.index
        )
        self._patches[first_keyframe] = (
            0  # blank, or a point without one would have that of the point whose row it took
        )
        keypoints = np.flatnonzero(
            (keyframe.point_ids >= 0) & (keyframe.features.octaves <= MAX_LEVEL)
        )
        keypoints = keypoints[
            self.world.first_keyframe[keyframe.point_ids[keypoints]] == keyframe.index
        ]
        ids, octaves = keyframe.point_ids[keypoints], keyframe.features.octaves[keypoints]
        patches = self._pyramid.cut(keyframe.features.pixels[keypoints], octaves, PATCH_PX)
        self._patches[ids] = np.rint(patches).reshape(-1, PATCH_PX, PATCH_PX)
        self._octaves[ids] = octaves
        keyframe.features.is_subpixel[keypoints] = (
            True  # where the patch lies, by which others are moved
        )

    def refine(self, features: Features, matches: Matches, T_cw: Array) -> Features:
        """The features with those matched corners moved that found a better place in the frame
        looked at.

        T_cw: [4, 4] the frame's pose.
        """
        assert self._pyramid is not None
        matches = matches.take(features.octaves[matches.keypoints] <= MAX_LEVEL)
        if len(matches) == 0:
            return features
        ids, keypoints = matches.points, matches.keypoints
        octaves = features.octaves[keypoints]
        A = affine(self.world, ids, T_cw)
        back = np.linalg.inv(A) * (SCALE ** (octaves - self._octaves[ids]))[:, None, None]
        template = warped(self._patches[ids], back, TEMPLATE_PX + 2)
        shift, good = align(self._pyramid, features.pixels[keypoints], octaves, template)
        rows = keypoints[good]
        pixels, points = features.pixels.copy(), features.points.copy()
        pixels[rows] += shift[good] * SCALE ** octaves[good, None]
        undistort = (
            self.world.camera.undistort
        )  # the difference, for points may be unrolled (`shutter`)
        points[rows] += undistort(pixels[rows]) - undistort(features.pixels[rows])
        is_subpixel = np.zeros(len(features), dtype=np.bool_)
        is_subpixel[rows] = True
        return replace(features, pixels=pixels, points=points, is_subpixel=is_subpixel)


def affine(world: Map, ids: NDArray[np.int64], T_cw: Array) -> Array:
    """A of eq. 9 for n points: [n, 2, 2] px of a camera at T_cw per px of the keyframe where each
    was first seen.
    """
    camera, points = world.camera, world.positions[ids]
    first_keyframe, which = np.unique(world.first_keyframe[ids], return_inverse=True)
    T_bw = np.stack([world.pose(index) for index in first_keyframe.tolist()])[which]
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
