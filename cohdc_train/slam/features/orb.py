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
        """Build one detector per FAST threshold, and the number of keypoints per pyramid level."""
        self.camera = camera
        self.config = config
        self.pyramid = ScalePyramid.from_config(config)
        self._detectors = [_orb(config, threshold) for threshold in config.fast_thresholds]
        self._latest = 0  # index of the threshold that sufficed for the latest frame
        levels = np.arange(config.num_levels)
        self._scales = self.pyramid.scales(levels)
        shares = config.scale_factor ** -levels.astype(np.float64)
        self._quota = np.ceil(shares / shares.sum() * config.max_keypoints).astype(np.int64)

    def __call__(
        self,
        rgb: NDArray[np.uint8],
        depth: NDArray[np.float32],
        mask: NDArray[np.bool_] | None = None,
        T_depth_color: NDArray[np.float64] | None = None,
    ) -> Features:
        """Detect the keypoints of a frame, and measure their depth.

        Args:
            rgb: [H, W, 3] uint8 RGB.
            depth: [H, W] m, 0 = no reading.
            mask: [H, W] bool, True = dynamic; no keypoint is detected there.
            T_depth_color: [4, 4] camera frame at the color image's time to that at the depth
                image's time, m, where the two differ.
        """
        return self.measure(self.find(rgb, mask), depth, mask, T_depth_color)

    def find(self, rgb: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> Keypoints:
        """Detect keypoints in an RGB image [H, W, 3] outside a mask [H, W], without depth."""
        gray = gray_of(rgb)
        allowed = None if mask is None else np.where(mask, 0, 255).astype(np.uint8)
        detected, table = self._detect(gray, allowed)
        cell_px = self.config.grid_cell_px * self._scales
        chosen = select_on_grid(table, self._quota, cell_px)
        kept, descriptors = self._detectors[0].compute(gray, [detected[i] for i in chosen])
        if descriptors is None:
            kept, descriptors = (), np.zeros((0, 32), dtype=np.uint8)
        pixels, octaves = _positions_and_levels(kept)
        # OpenCV measures positions from the center of a level's first pixel.
        pixels += 0.5 * (self._scales[octaves] - 1.0)[:, None]
        return Keypoints(
            pixels,
            octaves,
            np.ascontiguousarray(descriptors).view(np.uint64),
            np.zeros(len(pixels), np.bool_),
        )

    def measure(
        self,
        keypoints: Keypoints,
        depth: NDArray[np.float32],
        mask: NDArray[np.bool_] | None = None,
        T_depth_color: NDArray[np.float64] | None = None,
    ) -> Features:
        """Undistort keypoints, and read their depth; arguments as of `__call__`."""
        pixels = keypoints.pixels
        points = self.camera.undistort(pixels)
        depths = sample_depth(depth, pixels, self.config, mask)
        if T_depth_color is not None:
            depths = self._depths_at_color_time(
                depth, (pixels, points, depths), mask, T_depth_color
            )
        return Features(
            pixels,
            points,
            keypoints.octaves,
            keypoints.descriptors,
            depths,
            keypoints.is_subpixel,
            self.pyramid,
        )

    def _depths_at_color_time(
        self,
        depth: NDArray[np.float32],
        keypoints: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
        mask: NDArray[np.bool_] | None,
        T_depth_color: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return depths [n] m at the color image's time from a depth image of another time.

        Depth is read where each keypoint was when the depth image was taken, and moved back. A
        handheld Kinect moves by about 5 mm in the 17 ms between its two images.
        """
        pixels, points, depths = keypoints
        pixels_at_depth_time = self.camera.project(
            to_local(T_depth_color, self.camera.backproject(points, depths))
        )
        shift = np.nan_to_num(pixels_at_depth_time - points)
        shifted_depths = sample_depth(depth, pixels + shift, self.config, mask)
        return to_local(
            inverse(T_depth_color), self.camera.backproject(points + shift, shifted_depths)
        )[:, 2]

    def _detect(
        self, gray: NDArray[np.uint8], allowed: NDArray[np.uint8] | None
    ) -> tuple[Sequence[cv2.KeyPoint], NDArray[np.float64]]:
        """Detect keypoints with the highest FAST threshold that yields enough of them.

        The search begins with the threshold of the latest frame, which has no effect on the result:
        keypoints are sorted by level, row, and column, since OpenCV's own order depends on the
        threshold and would decide between equal responses.

        Returns:
            The keypoints, and the table of them that `select_on_grid` takes.
        """
        thresholds = self.config.fast_thresholds
        min_count = self.config.min_oversampling * self.config.max_keypoints
        for k in range(self._latest, len(thresholds)):
            found = self._detectors[k].detect(gray, allowed)
            if len(found) >= min_count:
                break
        responses = np.fromiter(map(attrgetter("response"), found), np.float64, len(found))
        while k > 0 and np.count_nonzero(responses >= thresholds[k - 1]) >= min_count:
            k -= 1
        self._latest = k
        positions, octaves = _positions_and_levels(found)
        order = np.lexsort((positions[:, 0], positions[:, 1], octaves))
        order = order[responses[order] >= thresholds[k]]
        return [found[i] for i in order], np.column_stack([positions, octaves, responses])[order]


def gray_of(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert an RGB image [H, W, 3] uint8 to gray [H, W] uint8."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _positions_and_levels(
    keypoints: Sequence[cv2.KeyPoint],
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the positions [n, 2] px and the pyramid levels [n] of OpenCV keypoints."""
    pixels = np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64).reshape(-1, 2)
    return pixels, np.fromiter(map(attrgetter("octave"), keypoints), np.int64, len(keypoints))


def _orb(config: FeatureConfig, threshold: int) -> cv2.ORB:
    """Return OpenCV's ORB detector with a FAST threshold."""
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

    Args:
        table: [n, 4] rows of (x px, y px, level, response).
        quota: [levels] number of keypoints per level.
        cell_px: [levels] side of a grid cell, px of level 0.

    Returns:
        The selected rows, ascending.
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
    """Return the index of each element within its group of sorted keys [n]: 0, 1, 2, ..."""
    index = np.arange(len(groups))
    starts = np.r_[True, groups[1:] != groups[:-1]][: len(groups)]
    return np.asarray(index - np.maximum.accumulate(np.where(starts, index, 0)), dtype=np.int64)
