"""ROS 2 messages to frames and back, without ROS: a message is anything with the fields of the type
that is named.

tools/ros2/cohdc_slam_node.py is the node around it. Poses go out in ROS's axes (REP 103: x forward,
y left, z up), where the first camera is taken to look level; inside, the world has the axes of the
first camera (x right, y down, z forward).
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.errors import DataError
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array

_COLORS: dict[str, tuple[int, int | None]] = {  # encoding: channels, and OpenCV's way to RGB
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
}
_DEPTHS = {
    "16UC1": ("u2", 1000.0),
    "mono16": ("u2", 1000.0),
    "32FC1": ("f4", 1.0),
}  # kind, units per m (REP 118)
_ROS_FROM_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def to_seconds(stamp: Any) -> float:
    """builtin_interfaces/Time to s."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def camera_from_message(info: Any) -> Camera:
    """sensor_msgs/CameraInfo to a camera. Raises DataError for a lens that five coefficients do not
    describe.
    """
    d = [*info.d, *[0.0] * max(0, 5 - len(info.d))]
    if any(d[5:]) or info.distortion_model not in ("", "plumb_bob", "rational_polynomial"):
        model = f"{info.distortion_model!r} of {len(info.d)} coefficients"
        raise DataError(
            f"camera info: distortion {model} is not plumb_bob; use the topics of rectified images"
        )
    if info.k[0] <= 0 or info.width <= 0:
        raise DataError(
            f"camera info: not calibrated, fx is {info.k[0]:g} and the width {info.width}"
        )
    k1, k2, p1, p2, k3 = (float(value) for value in d[:5])
    K = [float(value) for value in info.k]
    return Camera(
        K[0], K[4], K[2], K[5], int(info.width), int(info.height), 1000.0, k1, k2, p1, p2, k3
    )


def rgb_from_message(image: Any) -> NDArray[np.uint8]:
    """sensor_msgs/Image to [H, W, 3] uint8 RGB. Raises DataError unless it is rgb8, bgr8, rgba8,
    bgra8 or mono8.
    """
    if image.encoding not in _COLORS:
        raise DataError(
            f"colour image: encoding {image.encoding!r} is not one of {' '.join(_COLORS)}"
        )
    channels, code = _COLORS[image.encoding]
    pixels = _pixels(image, np.dtype("u1"), channels)
    return pixels.copy() if code is None else np.asarray(cv2.cvtColor(pixels, code), dtype=np.uint8)


def depth_from_message(image: Any) -> NDArray[np.float32]:
    """sensor_msgs/Image to [H, W] m, 0 = no reading. Raises DataError unless it is 16UC1 (mm),
    mono16 or 32FC1 (m).
    """
    if image.encoding not in _DEPTHS:
        raise DataError(
            f"depth image: encoding {image.encoding!r} is not one of {' '.join(_DEPTHS)}"
        )
    kind, scale = _DEPTHS[image.encoding]
    order = ">" if image.is_bigendian else "<"
    meters = _pixels(image, np.dtype(order + kind), 1).astype(np.float32) / np.float32(scale)
    return np.where(np.isfinite(meters), meters, 0).astype(np.float32)


def _pixels(image: Any, kind: np.dtype[Any], channels: int) -> NDArray[Any]:
    """[H, W] or [H, W, channels] of a message whose rows may be padded to `step` bytes."""
    row = image.width * channels * kind.itemsize
    data = np.frombuffer(bytes(image.data), dtype=np.uint8)
    if image.step < row or len(data) < image.height * image.step:
        told = f"{image.width}x{image.height} {image.encoding} of step {image.step}"
        raise DataError(f"image message: {len(data)} bytes are too few for {told}")
    rows = data[: image.height * image.step].reshape(image.height, image.step)[:, :row]
    shape = (image.height, image.width) if channels == 1 else (image.height, image.width, channels)
    return np.ascontiguousarray(rows).view(kind).reshape(shape)


def fill_pose(pose: Any, T_wc: Array) -> None:
    """Set a geometry_msgs/Pose to the camera's optical frame in ROS's axes. T_wc: [4, 4] camera to
    world, m.
    """
    from scipy.spatial.transform import Rotation

    T = _ROS_FROM_OPTICAL @ T_wc
    pose.position.x, pose.position.y, pose.position.z = (float(value) for value in T[:3, 3])
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    names = pose.orientation
    names.x, names.y, names.z, names.w = (float(value) for value in quaternion)


def fill_mask(image: Any, mask: NDArray[np.bool_]) -> None:
    """Set a sensor_msgs/Image to a mask: mono8, 255 = dynamic."""
    image.height, image.width = mask.shape
    image.encoding, image.is_bigendian, image.step = "mono8", 0, mask.shape[1]
    image.data = (mask.astype(np.uint8) * 255).tobytes()
