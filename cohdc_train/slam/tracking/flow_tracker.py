"""A frame's pose at once, before it is matched against the map or without: optical flow finds the
points that the last matched one saw.

Corners, descriptors and the search for both take most of a frame's time. A thirtieth of a second
later the same points are a few pixels on, and the patch around each says where. Flow starts from
the matched frame every time, never from a frame that was itself tracked by it, so that nothing adds
up.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.features.keypoints import Features, Keypoints
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.features.orb import gray_of
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array, to_local
from cohdc_train.slam.mapping.keyframe import Keyframe
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.optimization.pose import optimize_pose, pose_information
from cohdc_train.slam.optimization.reprojection import ReprojectionModel
from cohdc_train.slam.tracking.localizer import Fit
from cohdc_train.slam.tracking.motion_model import Prediction

_BETWEEN = 2  # frames in a row: ten times a second the map is consulted
_AT_MOST = 5  # while there is no time for more
_WINDOW = (13, 13)  # px of a patch
_LEVELS = 2  # of the image pyramid above the image itself
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)
_MANY = 500  # points, of which a frame follows only
_TURNS = 2  # every second, the next one the others: a pose needs no more, and most of the time goes into them
_LEAST = 50  # points that agree on a pose
_SHARE = 0.4  # of the points that set out, that agree on a pose
_MUCH_HAS_CHANGED = 0.6  # of them: where fewer agree, the frame is to be matched
_NEAR = 0.05  # m


@dataclass(frozen=True)
class _Start:
    """A matched frame.

    gray: [H, W] uint8; ids: [m] int64 points that are matched; corners: where, m of them; off: [m,
    2] px by which each lies beside its point's projection; masked: [m] bool, it was matched though
    a mask was given for it; reference: the keyframe that sees most of the points.
    """

    gray: NDArray[np.uint8]
    ids: NDArray[np.int64]
    keypoints: Keypoints
    off: Array
    masked: NDArray[np.bool_]
    reference: Keyframe | None

    def take(self, rows: NDArray[np.int64]) -> "_Start":
        """The same with the chosen points."""
        ids, keypoints = self.ids[rows], self.keypoints.take(rows)
        return replace(
            self, ids=ids, keypoints=keypoints, off=self.off[rows], masked=self.masked[rows]
        )


@dataclass(frozen=True)
class Followed:
    """Points that flow found. ids: [m] int64, of the map; corners: where they are, m of them."""

    ids: NDArray[np.int64]
    keypoints: Keypoints


class FlowTracker:
    """The poses of the frames after a matched one, without corners of their own."""

    def __init__(self, world: Map, reprojection: ReprojectionModel) -> None:
        self.map = world
        self._reprojection = reprojection
        self._start: _Start | None = None
        self._followed = 0
        self._set_out = self._agree = 0  # points

    def begin(
        self,
        rgb: NDArray[np.uint8],
        features: Features,
        fit: Fit | None,
        mask: NDArray[np.bool_] | None,
    ) -> None:
        """A frame has been matched: what it sees is followed from now on.

        fit: None when the place is lost; mask: [H, W] bool, as it was given. What has been matched
        under it all the same, because it is at rest, may be followed there.
        """
        self._start, self._followed = None, 0
        if fit is None or len(fit.matches) < _LEAST:
            return
        rows = fit.matches.keypoints
        keypoints = features.keypoints(rows)
        off = keypoints.pixels - self._seen_from(fit.T_cw, fit.matches.points)
        masked = _covered(keypoints.pixels, mask)
        self._start = _Start(
            gray_of(rgb), fit.matches.points, keypoints, off, masked, fit.reference
        )

    def follow(
        self, rgb: NDArray[np.uint8], mask: NDArray[np.bool_] | None, T_cw: Array
    ) -> Followed | None:
        """Look for the points in the next frame; None when there is nothing to look for.

        rgb: [H, W, 3]; mask: [H, W] bool, True = dynamic: nothing is followed to there; T_cw: [4,
        4] expected pose.
        """
        if self._start is None:
            return None
        self._followed += 1
        before = self._start
        if len(before.ids) >= _MANY:
            before = before.take(np.flatnonzero(before.ids % _TURNS == self._followed % _TURNS))
        self._set_out = len(before.ids)
        guess = (self._seen_from(T_cw, before.ids) + before.off).astype(np.float32)
        starts, flags = before.keypoints.pixels.astype(np.float32), cv2.OPTFLOW_USE_INITIAL_FLOW
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            before.gray, gray_of(rgb), starts, guess, None, None, _WINDOW, _LEVELS, _STOP, flags
        )
        pixels = np.asarray(found, dtype=np.float64)
        rows = np.flatnonzero((status[:, 0] > 0) & _inside(pixels, self.map.camera))
        rows = rows[before.masked[rows] | ~_covered(pixels[rows], mask)]
        known = before.ids[rows]
        ids, first = np.unique(self.map.current(known), return_index=True)
        rows, same = rows[first], ids == known[first]
        keypoints = before.keypoints.take(rows)
        return Followed(
            ids, replace(keypoints, pixels=pixels[rows], is_subpixel=keypoints.is_subpixel & same)
        )

    def locate(self, followed: Followed, features: Features, expected: Prediction) -> Fit | None:
        """The pose on which enough of the points agree. features: of the followed corners."""
        assert self._start is not None
        least = max(_LEAST, _SHARE * self._set_out)
        if len(features) < least:
            return None
        matches = Matches(followed.ids, np.arange(len(features)))
        points, seen = self.map.measured(matches, features)
        prior = expected.given(len(features))
        T_cw, inlier = optimize_pose(
            expected.prior.T_cw, points, seen, self._reprojection, prior=prior
        )
        self._agree = int(inlier.sum())
        if self._agree < least:
            return None
        information = pose_information(T_cw, points[inlier], seen.take(inlier), self._reprojection)
        return Fit(T_cw, matches.take(inlier), self._start.reference, prior, information)

    @property
    def left(self) -> float:
        """Share of the points that set out on which the latest answer stands: a view that changes
        loses them.
        """
        return self._agree / self._set_out

    def over(self, hurry: bool, busy: bool = False) -> bool:
        """Whether the frame that was followed to is to be matched, and be begun from.

        hurry: it may wait; busy: it would not become a keyframe, so that it may wait unless much
        has changed.
        """
        if hurry:
            return self._followed > _AT_MOST
        return self._followed > (_AT_MOST if busy else _BETWEEN) or self.left < _MUCH_HAS_CHANGED

    def _seen_from(self, T_cw: Array, ids: NDArray[np.int64]) -> Array:
        """[m, 2] px as the lens shows them, of points of the map."""
        local = to_local(T_cw, self.map.positions[ids])
        local[:, 2] = np.maximum(local[:, 2], _NEAR)
        camera = self.map.camera
        return camera.distort(camera.project(local))


def _inside(pixels: Array, camera: Camera) -> NDArray[np.bool_]:
    """[m] bool, of pixels [m, 2]: in the image."""
    x, y = np.rint(pixels).T
    return np.asarray((x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height))


def _covered(pixels: Array, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """[m] bool, of pixels [m, 2] in the image: under the mask."""
    if mask is None:
        return np.zeros(len(pixels), dtype=np.bool_)
    x, y = np.rint(pixels).astype(np.int64).T
    return np.asarray(mask[y, x])
