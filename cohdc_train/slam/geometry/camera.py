"""The pinhole camera with Brown-Conrady distortion: its yaml file, and the choice of one for a sequence."""

import math
import re
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.presets import config_path

_REQUIRED = ("fx", "fy", "cx", "cy", "width", "height", "depth_scale")
_FREIBURG = re.compile(r"(?:freiburg|fr)([123])(?![0-9])", re.IGNORECASE)


@dataclass(frozen=True)
class Camera:
    """Intrinsics in px; a stored depth value divided by `depth_scale` is metres along the optical axis.

    baseline: m from the left camera of a rectified stereo pair to the right one; 0 for a camera that measures depth.
    readout: s from the colour image's first row to its last; 0 for a camera that takes all rows at once.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    depth_scale: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    baseline: float = 0.0
    readout: float = 0.0

    @property
    def far(self) -> float:
        """m: depth beyond errs too much to begin with: by 4 cm and more, a Kinect's; 40 baselines, a stereo pair's."""
        return 40 * self.baseline if self.baseline else 5.0

    @property
    def distortion(self) -> NDArray[np.float64]:
        """[5] Brown-Conrady coefficients in OpenCV's order, all 0 for a lens without."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    def matrix(self) -> NDArray[np.float64]:
        """K: [3, 3], px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def undistort(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """pixels: [n, 2] as measured, px. Returns [n, 2] px where a lens without distortion would put them."""
        if not self.distortion.any() or len(pixels) == 0:
            return np.asarray(pixels, dtype=np.float64).copy()
        # The default stops at an error of 0.01 px and more in the corners of freiburg1.
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-6)
        points = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        flat = cv2.undistortImagePoints(points, self.matrix(), self.distortion, None, criteria)
        return np.asarray(flat, dtype=np.float64).reshape(-1, 2)

    def distort(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """pixels: [n, 2] without distortion, px. Returns [n, 2] px where the lens puts them: undistort's inverse."""
        if not self.distortion.any() or len(pixels) == 0:
            return np.asarray(pixels, dtype=np.float64).copy()
        rays = self.backproject(pixels, np.ones(len(pixels))).reshape(-1, 1, 3)
        bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), self.matrix(), self.distortion)
        return np.asarray(bent, dtype=np.float64).reshape(-1, 2)

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """points: [..., 3] in the camera frame, m, z > 0. Returns [..., 2] undistorted px."""
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)

    def backproject(self, pixels: NDArray[np.float64], depth: NDArray[np.float64]) -> NDArray[np.float64]:
        """pixels: [n, 2] undistorted px; depth: [n] m. Returns [n, 3] in the camera frame, m."""
        x = (pixels[:, 0] - self.cx) / self.fx * depth
        y = (pixels[:, 1] - self.cy) / self.fy * depth
        return np.stack([x, y, depth], axis=1)

    def as_dict(self) -> dict[str, float]:
        """What the yaml file of this camera holds."""
        return asdict(self)


@cache
def maps_onto(camera: Camera, pinhole: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What cv2.remap needs to make a camera's image one that a pinhole camera in its place would take."""
    size = (pinhole.width, pinhole.height)
    matrices = camera.matrix(), camera.distortion, None, pinhole.matrix()
    x, y = cv2.initUndistortRectifyMap(*matrices, size, cv2.CV_32FC1)
    return np.asarray(x, np.float32), np.asarray(y, np.float32)


def load_camera(path: Path) -> Camera:
    """Read `fx fy cx cy width height depth_scale` and, 0 where absent, `k1 k2 p1 p2 k3`, `baseline`, `readout`.

    A camera with a baseline needs no depth_scale.

    Raises DataError naming the file, and the line where there is one, for yaml that cannot be parsed, a missing or
    unknown key, or a value that is not a usable number.
    """
    values: dict[str, float] = {}
    known = {field.name for field in fields(Camera)}
    for key, value, line in _numbers(path):
        if key not in known:
            raise DataError(f"{path}:{line}: unknown key {key!r}; a camera has {' '.join(sorted(known))}")
        if key in _REQUIRED and key not in ("cx", "cy") and value <= 0:
            raise DataError(f"{path}:{line}: {key} must be above 0, not {value:g}")
        if key in ("baseline", "readout") and value < 0:
            raise DataError(f"{path}:{line}: {key} cannot be below 0, and is {value:g}")
        values[key] = value
    if values.get("baseline"):
        values.setdefault("depth_scale", 1.0)
    missing = [key for key in _REQUIRED if key not in values]
    if missing:
        raise DataError(f"{path}: missing {' '.join(missing)}")
    width, height = int(values.pop("width")), int(values.pop("height"))
    return Camera(width=width, height=height, **values)


def choose_camera(sequence: Path, given: Path | None) -> tuple[Camera, str]:
    """The camera of a sequence, and a phrase that says where it came from.

    Order: `given`, `camera.yaml` in the sequence's folder, the freiburg1/2/3 preset that the folder's name calls for.
    Raises DataError when none of the three applies.
    """
    if given is not None:
        path = config_path(given)
        return load_camera(path), f"{given}, as asked"
    beside = sequence / "camera.yaml"
    if beside.is_file():
        return load_camera(beside), f"{beside}, beside the sequence"
    name = sequence.resolve().name
    match = _FREIBURG.search(name)
    if match is None:
        message = f"{sequence}: cannot tell the camera from the folder's name; put camera.yaml there or give --camera"
        raise DataError(message)
    preset = f"slam/freiburg{match.group(1)}.yaml"
    return load_camera(config_path(preset)), f"preset {preset}, guessed from the folder's name {name}"


def _numbers(path: Path) -> list[tuple[str, float, int]]:
    """(key, value, line) of a flat yaml mapping of numbers."""
    try:
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = "" if mark is None else f":{mark.line + 1}"
        problem = getattr(error, "problem", None) or "not yaml"
        raise DataError(f"{path}{line}: broken yaml: {problem}") from error
    if not isinstance(root, yaml.MappingNode):
        raise DataError(f"{path}:1: a camera file holds lines such as 'fx: 525.0'")
    rows: list[tuple[str, float, int]] = []
    for key, value in root.value:
        line = key.start_mark.line + 1
        try:
            number = float(value.value)
        except (TypeError, ValueError) as error:
            raise DataError(f"{path}:{line}: {key.value} is not a number") from error
        if not math.isfinite(number):
            raise DataError(f"{path}:{line}: {key.value} is not a finite number")
        rows.append((str(key.value), number, line))
    return rows
