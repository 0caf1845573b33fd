"""Poses of all tracked frames, stored relative to keyframes that mapping may move later."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cohdc_train.slam.geometry.se3 import Array, inverse
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.trajectory_smoothing import TrackedPoses


class _Logged(NamedTuple):
    """Stored frame.

    timestamp: s; reference: index of its reference keyframe; relative: [4, 4] camera of that
    keyframe to camera of the frame, m; information: [6, 6] inverse covariance of the pose;
    prior_gradient: [6] gradient of the motion prior at the pose.
    """

    timestamp: float
    reference: int
    relative: Array
    information: Array
    prior_gradient: Array


class FrameHistory:
    """Tracked frames of a run, in order of time."""

    def __init__(self) -> None:
        self._frames: list[_Logged] = []

    def append(
        self,
        timestamp: float,
        T_cw: Array,
        reference: Keyframe | None,
        information: Array,
        prior_gradient: Array,
        point_map: Map,
    ) -> int:
        """Append a tracked frame, and return its row.

        Args:
            timestamp: s.
            T_cw: [4, 4] world to camera, m.
            reference: keyframe that the pose is stored relative to.
            information: [6, 6] inverse covariance of the pose by the frame's measurements.
            prior_gradient: [6] gradient of the motion prior at the pose.
            point_map: the map, which has the keyframe's pose.
        """
        if reference is None:
            raise ValueError(f"frame at {timestamp:.6f} s has no reference keyframe")
        relative = T_cw @ inverse(point_map.pose(reference.index))
        self._frames.append(
            _Logged(timestamp, reference.index, relative, information, prior_gradient)
        )
        return len(self._frames) - 1

    @property
    def timestamps(self) -> Array:
        """Return the timestamps [n] s."""
        return np.array([frame.timestamp for frame in self._frames])

    def poses(self, point_map: Map) -> Array:
        """Return the poses [n, 4, 4] T_cw, world to camera, m, in the current map.

        Each pose is computed from its reference keyframe, or from that keyframe's successor.
        """
        references = [frame.reference for frame in self._frames]
        keyframes = {index: point_map.pose(index) for index in set(references)}
        poses = [frame.relative @ keyframes[frame.reference] for frame in self._frames]
        return np.stack(poses) if poses else np.zeros((0, 4, 4))

    def update_poses(self, point_map: Map, rows: Sequence[int], poses: Array) -> None:
        """Set the poses [m, 4, 4] T_cw, m, of the frames in rows [m], in the current map."""
        for row, pose in zip(rows, poses, strict=True):
            frame = self._frames[row]
            self._frames[row] = frame._replace(
                relative=pose @ inverse(point_map.pose(frame.reference))
            )

    def tracked_poses(self, point_map: Map) -> TrackedPoses:
        """Return all frames for smoothing, with their poses in the current map."""
        information = [frame.information for frame in self._frames]
        gradients = [frame.prior_gradient for frame in self._frames]
        return TrackedPoses(
            self.timestamps,
            self.poses(point_map),
            np.stack(information) if information else np.zeros((0, 6, 6)),
            np.stack(gradients) if gradients else np.zeros((0, 6)),
        )
