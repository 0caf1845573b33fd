"""Conversion of ROS 2 messages, without ROS: a message is any object with the fields of its type.

tools/ros2/cohdc_slam_node.py is the node. Published poses have ROS's axes (REP 103: x forward, y
left, z up), where the first camera is taken to look level. Inside, the world has the axes of the
first camera (x right, y down, z forward).
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cohdc_train.errors import DataError
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array

# Encoding: number of channels, and OpenCV's conversion to RGB.
_COLORS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
}
# Encoding: NumPy's type, and units per m (REP 118).
_DEPTHS = {
    "16UC1": ("u2", 1000.0),
    "mono16": ("u2", 1000.0),
    "32FC1": ("f4", 1.0),
}
_DISTORTIONS = ("", "plumb_bob", "rational_polynomial")
_ROS_FROM_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def to_seconds(stamp: Any) -> float:
    """Convert builtin_interfaces/Time to s."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def camera_from_message(info: Any) -> Camera:
    """Convert sensor_msgs/CameraInfo.

    Raises:
        DataError: the camera is not calibrated, or five coefficients do not describe its lens.
    """
    coefficients = [*info.d, *[0.0] * max(0, 5 - len(info.d))]
    if any(coefficients[5:]) or info.distortion_model not in _DISTORTIONS:
        model = f"{info.distortion_model!r} with {len(info.d)} coefficients"
        fix = "use the topics of rectified images"
        raise DataError(f"camera info: distortion {model} is not plumb_bob; {fix}")
    if info.k[0] <= 0 or info.width <= 0:
        found = f"fx is {info.k[0]:g} and the width {info.width}"
        raise DataError(f"camera info: not calibrated, {found}")
    k1, k2, p1, p2, k3 = (float(value) for value in coefficients[:5])
    K = [float(value) for value in info.k]
    return Camera(
        fx=K[0],
        fy=K[4],
        cx=K[2],
        cy=K[5],
        width=int(info.width),
        height=int(info.height),
        depth_scale=1000.0,
        k1=k1,
        k2=k2,
        p1=p1,
        p2=p2,
        k3=k3,
    )


def rgb_from_message(image: Any) -> NDArray[np.uint8]:
    """Convert sensor_msgs/Image to [H, W, 3] uint8 RGB.

    Raises:
        DataError: the encoding is not rgb8, bgr8, rgba8, bgra8 or mono8.
    """
    if image.encoding not in _COLORS:
        known = " ".join(_COLORS)
        raise DataError(f"color image: encoding {image.encoding!r} is not one of {known}")
    num_channels, conversion = _COLORS[image.encoding]
    pixels = _read_pixels(image, np.dtype("u1"), num_channels)
    if conversion is None:
        return pixels.copy()
    return np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)


def depth_from_message(image: Any) -> NDArray[np.float32]:
    """Convert sensor_msgs/Image to [H, W] m, 0 = no reading.

    Raises:
        DataError: the encoding is not 16UC1 (mm), mono16 (mm) or 32FC1 (m).
    """
    if image.encoding not in _DEPTHS:
        known = " ".join(_DEPTHS)
        raise DataError(f"depth image: encoding {image.encoding!r} is not one of {known}")
    kind, units_per_m = _DEPTHS[image.encoding]
    order = ">" if image.is_bigendian else "<"
    units = _read_pixels(image, np.dtype(order + kind), 1).astype(np.float32)
    meters = units / np.float32(units_per_m)
    return np.where(np.isfinite(meters), meters, 0).astype(np.float32)


def _read_pixels(image: Any, kind: np.dtype[Any], num_channels: int) -> NDArray[Any]:
    """Return the pixels of a message, whose rows may be padded to `step` bytes.

    Returns:
        [H, W], or [H, W, num_channels] for more than one.
    """
    row_bytes = image.width * num_channels * kind.itemsize
    data = np.frombuffer(bytes(image.data), dtype=np.uint8)
    if image.step < row_bytes or len(data) < image.height * image.step:
        size = f"{image.width}x{image.height} {image.encoding} of step {image.step}"
        raise DataError(f"image message: {len(data)} bytes are too few for {size}")
    rows = data[: image.height * image.step].reshape(image.height, image.step)[:, :row_bytes]
    pixels = np.ascontiguousarray(rows).view(kind)
    if num_channels == 1:
        return pixels.reshape(image.height, image.width)
    return pixels.reshape(image.height, image.width, num_channels)


def fill_pose(pose: Any, T_wc: Array) -> None:
    """Set a geometry_msgs/Pose to the pose of the optical frame in ROS's axes.

    Args:
        pose: message to fill.
        T_wc: [4, 4] camera to world, m.
    """
    T = _ROS_FROM_OPTICAL @ T_wc
    position, orientation = pose.position, pose.orientation
    position.x, position.y, position.z = (float(value) for value in T[:3, 3])
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    x, y, z, w = (float(value) for value in quaternion)
    orientation.x, orientation.y, orientation.z, orientation.w = x, y, z, w


def fill_mask(image: Any, mask: NDArray[np.bool_]) -> None:
    """Set a sensor_msgs/Image to a mask [H, W]: mono8, 255 = dynamic."""
    image.height, image.width = mask.shape
    image.encoding = "mono8"
    image.is_bigendian = 0
    image.step = mask.shape[1]
    image.data = (mask.astype(np.uint8) * 255).tobytes()
