"""ORB keypoints spread over the image outside the dynamic mask, with reliable depth."""

from collections.abc import Sequence
from operator import attrgetter

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.slam.config import FeatureConfig
from cohdc_train.slam.features.depth_sampling import sample_depth
from cohdc_train.slam.features.keypoints import Features, Keypoints, ScalePyramid
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import inverse, to_local


class OrbExtractor:
    """Extractor of up to config.max_keypoints ORB keypoints per frame, none under the mask."""

    def __init__(self, camera: Camera, config: FeatureConfig = FeatureConfig()) -> None:
        self.camera = camera
        self.config = config
        self.pyramid = ScalePyramid.from_config(config)
        self._detectors = [_orb(config, threshold) for threshold in config.fast_thresholds]
        self._latest = 0  # threshold that was low enough for the latest frame
        levels = np.arange(config.num_levels)
        self._scales = self.pyramid.scales(levels)
        shares = config.scale_factor ** -levels.astype(np.float64)
        self._quota = np.ceil(shares / shares.sum() * config.max_keypoints).astype(np.int64)

    def __call__(
        self,
        rgb: NDArray[np.uint8],
        depth: NDArray[np.float32],
        mask: NDArray[np.bool_] | None = None,
        lag: NDArray[np.float64] | None = None,
    ) -> Features:
        """rgb: [H, W, 3] RGB; depth: [H, W] m, 0 = none; mask: [H, W] bool, True = dynamic: no
        corner there.

        lag: [4, 4] from the camera's frame at the colour image's time to that at depth's, where
        they differ.
        """
        return self.measure(self.find(rgb, mask), depth, mask, lag)

    def find(self, rgb: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> Keypoints:
        """The corners alone; arguments as above."""
        gray = gray_of(rgb)
        allowed = None if mask is None else np.where(mask, 0, 255).astype(np.uint8)
        found, table = self._detect(gray, allowed)
        cell_px = self.config.grid_cell_px * self._scales
        chosen = select_on_grid(table, self._quota, cell_px)
        kept, words = self._detectors[0].compute(gray, [found[i] for i in chosen])
        if words is None:
            kept, words = (), np.zeros((0, 32), dtype=np.uint8)
        pixels, octaves = _places(kept)
        # ORB counts from the middle of a level's first pixel.
        pixels += 0.5 * (self._scales[octaves] - 1.0)[:, None]
        return Keypoints(
            pixels,
            octaves,
            np.ascontiguousarray(words).view(np.uint64),
            np.zeros(len(pixels), np.bool_),
        )

    def measure(
        self,
        keypoints: Keypoints,
        depth: NDArray[np.float32],
        mask: NDArray[np.bool_] | None = None,
        lag: NDArray[np.float64] | None = None,
    ) -> Features:
        """What camera and depth image say of corners; arguments as above."""
        pixels = keypoints.pixels
        points = self.camera.undistort(pixels)
        depths = sample_depth(depth, pixels, self.config, mask)
        if lag is not None:
            depths = self._caught_up(depth, (pixels, points, depths), mask, lag)
        return Features(
            pixels,
            points,
            keypoints.octaves,
            keypoints.descriptors,
            depths,
            keypoints.is_subpixel,
            self.pyramid,
        )

    def _caught_up(
        self,
        depth: NDArray[np.float32],
        keypoints: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
        mask: NDArray[np.bool_] | None,
        lag: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Depths at the colour image's time: read where each corner was when depth was taken, and
        carried back.

        A hand moves a Kinect by half a centimetre in the 17 ms that its two images lie apart.
        """
        pixels, points, depths = keypoints
        there = self.camera.project(to_local(lag, self.camera.backproject(points, depths)))
        shift = np.nan_to_num(there - points)
        moved = sample_depth(depth, pixels + shift, self.config, mask)
        return to_local(inverse(lag), self.camera.backproject(points + shift, moved))[:, 2]

    def _detect(
        self, gray: NDArray[np.uint8], allowed: NDArray[np.uint8] | None
    ) -> tuple[Sequence[cv2.KeyPoint], NDArray[np.float64]]:
        """Corners above the highest threshold that leaves enough, and the table of them that
        `select_on_grid` takes.

        Which threshold was tried first, the latest frame's, makes no difference to that: ORB's own
        order, which depends on it and would decide between corners of one response, gives way to
        level, row and column.
        """
        thresholds = self.config.fast_thresholds
        enough = self.config.min_oversampling * self.config.max_keypoints
        for k in range(self._latest, len(thresholds)):
            found = self._detectors[k].detect(gray, allowed)
            if len(found) >= enough:
                break
        responses = np.fromiter(map(attrgetter("response"), found), np.float64, len(found))
        while k > 0 and np.count_nonzero(responses >= thresholds[k - 1]) >= enough:
            k -= 1
        self._latest = k
        places, octaves = _places(found)
        order = np.lexsort((places[:, 0], places[:, 1], octaves))
        order = order[responses[order] >= thresholds[k]]
        return [found[i] for i in order], np.column_stack([places, octaves, responses])[order]


def gray_of(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """rgb: [H, W, 3] uint8 RGB. Returns [H, W] uint8."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _places(keypoints: Sequence[cv2.KeyPoint]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """[n, 2] px and [n] pyramid levels."""
    pixels = np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64).reshape(-1, 2)
    return pixels, np.fromiter(map(attrgetter("octave"), keypoints), np.int64, len(keypoints))


def _orb(config: FeatureConfig, threshold: int) -> cv2.ORB:
    return cv2.ORB.create(
        nfeatures=int(config.max_keypoints * config.oversampling),
        scaleFactor=config.scale_factor,
        nlevels=config.num_levels,
        edgeThreshold=19,
        scoreType=cv2.ORB_FAST_SCORE,
        fastThreshold=threshold,
    )


def select_on_grid(
    table: NDArray[np.float64], quota: NDArray[np.int64], cell_px: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Select keypoints evenly: per pyramid level the best of every grid cell, then the second best.

    table: [n, 4] rows of (x px, y px, level, response); quota: [levels] how many of each level;
    cell_px: [levels] side of a cell, px of level 0. Returns rising rows.
    """
    best_first = np.argsort(-table[:, 3], kind="stable")
    octave = table[best_first, 2].astype(np.int64)
    column, row = (table[best_first, :2].T // cell_px[octave]).astype(np.int64)
    cell = (octave * 10_000 + row) * 10_000 + column
    order = np.argsort(cell, kind="stable")
    rank = np.empty(len(table), dtype=np.int64)
    rank[order] = _running_index(cell[order])
    order = np.argsort(octave * len(table) + rank, kind="stable")
    chosen = order[_running_index(octave[order]) < quota[octave[order]]]
    return np.sort(best_first[chosen])


def _running_index(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """groups: [n] sorted keys. Returns [n] 0, 1, 2, ... restarting at every new key."""
    index = np.arange(len(groups))
    starts = np.r_[True, groups[1:] != groups[:-1]][: len(groups)]
    return np.asarray(index - np.maximum.accumulate(np.where(starts, index, 0)), dtype=np.int64)
