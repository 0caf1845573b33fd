"""The map of a SLAM run from above, with the camera's path and a scale bar."""

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.report.slam_run import Floats, SlamRun

Image = NDArray[np.uint8]

_SIDE = 1100  # px of the image's longer side
_SHORTEST = 0.45  # of the longer side, so that the scale bar has room
_BORDER = 34  # px
_ABOVE = 0.4  # m above the cameras from which on points are skipped: a ceiling hides the room
_BACKGROUND, _PATH, _WHITE = (52, 43, 36), (71, 107, 255), (245, 245, 245)  # BGR
_VERTEX = np.dtype([("position", "<f4", 3), ("color", "u1", 3)])


def draw_map(run: SlamRun) -> Image | None:
    """Draw map.ply of a run. Returns [H, W, 3] BGR; None without a map or a path.

    Up is where the cameras' upper edges point on average; the first camera looks to the top of the
    image. Raises DataError for a file that is not of `cohdc slam`.
    """
    file = run.folder / "map.ply"
    if run.trajectory is None or not file.is_file():
        return None
    points, colors = read_points(file)
    points = points @ run.T[:3, :3].T + run.T[:3, 3]
    axes, up = _axes(run.trajectory.poses)
    path = run.path()[1]
    height = points @ up
    keep = height < (run.trajectory.positions @ up).max() + _ABOVE
    order = np.flatnonzero(keep)[np.argsort(height[keep], kind="stable")]  # the highest come last
    return _draw(points[order] @ axes, colors[order], path @ axes)


def read_points(file: Path) -> tuple[Floats, Image]:
    """Read a PLY of colored points as `cohdc slam` writes it.

    Returns points [n, 3], m, and colors [n, 3] uint8 RGB. Raises DataError for another file.
    """
    content = file.read_bytes()
    head, found, body = content.partition(b"end_header\n")
    usual = b"format binary_little_endian" in head and head.count(b"property") == 6
    if not found or not usual or len(body) % _VERTEX.itemsize:
        raise DataError(f"{file}: is no map of cohdc slam")
    rows = np.frombuffer(body, _VERTEX)
    return rows["position"].astype(np.float64), np.asarray(rows["color"])


def scale_length(meters: float) -> float:
    """Return a round length for a scale bar: 1, 2 or 5 times a power of ten.

    It is at most a quarter of the image's width. meters: that width.
    """
    power = 10.0 ** math.floor(math.log10(meters / 4))
    return max(step * power for step in (1, 2, 5) if step * power <= meters / 4)


def _axes(poses: Floats) -> tuple[Floats, Floats]:
    """Return [3, 2] axes to the right and down in the image, and the direction up [3]."""
    up = -poses[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up) + 1e-12
    forward = poses[0, :3, 2] - up * (poses[0, :3, 2] @ up)
    forward /= np.linalg.norm(forward) + 1e-12
    return np.stack([np.cross(forward, up), -forward], axis=1), up


def _draw(points: Floats, colors: Image, path: Floats) -> Image:
    """Draw points [n, 2] and a path [m, 2] with nan rows at its gaps, m."""
    seen = path[np.isfinite(path[:, 0])]
    low, high = np.quantile(np.concatenate([points, seen]), [0.005, 0.995], axis=0)
    low, high = np.minimum(low, seen.min(axis=0)), np.maximum(high, seen.max(axis=0))
    extent = np.maximum(high - low, _SHORTEST * float((high - low).max()) + 1e-3)
    low -= (extent - (high - low)) / 2
    scale = (_SIDE - 2 * _BORDER) / float(extent.max())
    width, rows = (np.ceil(extent * scale).astype(int) + 2 * _BORDER).tolist()
    image = np.full((rows, width, 3), _BACKGROUND, np.uint8)
    _draw_points(image, (points - low) * scale + _BORDER, colors)
    places = (path - low) * scale + _BORDER
    for part in np.split(places, np.flatnonzero(~np.isfinite(places[:, 0]))):
        line = np.rint(part[np.isfinite(part[:, 0])]).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(image, [line], False, _WHITE, 4, cv2.LINE_AA)
        cv2.polylines(image, [line], False, _PATH, 2, cv2.LINE_AA)
    cv2.circle(image, np.rint(places[0]).astype(int).tolist(), 7, _WHITE, -1, cv2.LINE_AA)
    _draw_scale(image, scale)
    return image


def _draw_points(image: Image, places: Floats, colors: Image) -> None:
    height, width = image.shape[:2]
    radius = int(np.clip(np.sqrt(height * width / (len(places) + 1)) / 4, 1, 2))
    columns, rows = np.rint(places).astype(np.int64).reshape(-1, 2).T
    for dx in range(-radius, radius + 1):
        for dy in range(-radius, radius + 1):
            x, y = columns + dx, rows + dy
            inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
            image[y[inside], x[inside]] = colors[inside][:, ::-1]


def _draw_scale(image: Image, scale: float) -> None:
    """Draw a scale bar into the lower left. scale: px/m."""
    meters = scale_length(image.shape[1] / scale)
    length, y = round(meters * scale), image.shape[0] - 20
    text = f"{meters:g} m" if meters >= 1 else f"{100 * meters:g} cm"
    box = image[y - 66 : y + 14, 10 : 34 + max(length, 150)]
    box[:] = box // 3
    cv2.line(image, (22, y), (22 + length, y), _WHITE, 4)
    for x in (22, 22 + length):
        cv2.line(image, (x, y - 7), (x, y + 7), _WHITE, 3)
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(image, text, (22, y - 18), font, 1.3, _WHITE, 3, cv2.LINE_AA)
