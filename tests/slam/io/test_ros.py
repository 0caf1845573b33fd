"""Conversion of ROS 2 messages, and the node with stand-ins for rclpy."""

import os
import signal
import sys
import threading
from array import array
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, render, room
from scipy.spatial.transform import Rotation
from tool_loader import load_tool

from cohdc_train.errors import DataError
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.ros import (
    camera_from_message,
    depth_from_message,
    fill_mask,
    fill_pose,
    rgb_from_message,
    to_seconds,
)
from cohdc_train.trajectory.trajectory import Trajectory

FRAMES = 8


def image(
    encoding: str, pixels: NDArray[Any], padding: int = 0, big: bool = False
) -> SimpleNamespace:
    """Return a sensor_msgs/Image as a driver fills it; padding: bytes at the end of a row."""
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))).view(
        np.uint8
    )
    padded = np.pad(rows.reshape(height, -1), ((0, 0), (0, padding)))
    data = array("B", padded.tobytes())
    step = padded.shape[1]
    return SimpleNamespace(
        height=height, width=width, encoding=encoding, is_bigendian=int(big), step=step, data=data
    )


@pytest.fixture
def rgb() -> NDArray[np.uint8]:
    return np.random.default_rng(0).integers(0, 256, (6, 9, 3)).astype(np.uint8)


@pytest.mark.parametrize("padding", [0, 5])
def test_color_encodings(rgb: NDArray[np.uint8], padding: int) -> None:
    alpha = np.full((6, 9, 1), 7, np.uint8)
    messages = {
        "rgb8": rgb,
        "bgr8": rgb[..., ::-1],
        "rgba8": np.concatenate([rgb, alpha], axis=2),
        "bgra8": np.concatenate([rgb[..., ::-1], alpha], axis=2),
    }
    for encoding, pixels in messages.items():
        np.testing.assert_array_equal(
            rgb_from_message(image(encoding, pixels, padding)), rgb, err_msg=encoding
        )
    gray = rgb_from_message(image("mono8", rgb[..., 0], padding))
    np.testing.assert_array_equal(gray, np.repeat(rgb[..., :1], 3, axis=2))


@pytest.mark.parametrize("big", [False, True])
def test_depth_encodings(big: bool) -> None:
    meters = np.array([[0.0, 1.234, 2.5], [np.nan, np.inf, 4.0]], np.float32)
    millimeters = np.array([[0, 1234, 2500], [0, 0, 4000]], np.uint16)
    expected = np.array([[0, 1.234, 2.5], [0, 0, 4]], np.float32)
    for message in (image("32FC1", meters, 8, big), image("16UC1", millimeters, 2, big)):
        depth = depth_from_message(message)
        assert depth.dtype == np.float32
        np.testing.assert_allclose(depth, expected, rtol=1e-6)


def test_unusable_messages_are_named(rgb: NDArray[np.uint8]) -> None:
    with pytest.raises(DataError, match="encoding 'yuv422' is not one of rgb8 bgr8"):
        rgb_from_message(image("yuv422", rgb))
    with pytest.raises(DataError, match="encoding 'rgb8' is not one of 16UC1"):
        depth_from_message(image("rgb8", rgb))
    short = image("rgb8", rgb)
    short.data = short.data[:-1]
    with pytest.raises(DataError, match="161 bytes are too few for 9x6 rgb8 of step 27"):
        rgb_from_message(short)


def info(**changes: Any) -> SimpleNamespace:
    k = [CAMERA.fx, 0, CAMERA.cx, 0, CAMERA.fy, CAMERA.cy, 0, 0, 1]
    values: dict[str, Any] = {
        "width": 320,
        "height": 240,
        "k": k,
        "d": [],
        "distortion_model": "plumb_bob",
    }
    return SimpleNamespace(**values | changes)


def test_camera_info() -> None:
    plain = camera_from_message(info())
    assert plain == Camera(260.0, 260.0, 159.5, 119.5, 320, 240, 1000.0)
    bent = camera_from_message(info(d=[0.1, -0.2, 0.001, 0.002, 0.3]))
    assert (bent.k1, bent.k2, bent.p1, bent.p2, bent.k3) == (0.1, -0.2, 0.001, 0.002, 0.3)
    assert (
        camera_from_message(
            info(d=[0.1, 0, 0, 0, 0, 0, 0, 0], distortion_model="rational_polynomial")
        ).k1
        == 0.1
    )
    with pytest.raises(DataError, match="'equidistant' with 4 coefficients"):
        camera_from_message(info(d=[0.1] * 4, distortion_model="equidistant"))
    with pytest.raises(DataError, match="with 8 coefficients"):
        camera_from_message(info(d=[0.1] * 8, distortion_model="rational_polynomial"))
    with pytest.raises(DataError, match="not calibrated, fx is 0"):
        camera_from_message(info(k=[0] * 9))


def pose_message() -> SimpleNamespace:
    return SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())


def test_poses_are_published_in_the_axes_of_ros() -> None:
    """The first camera looks along x, with its upper edge along z."""
    T_wc = np.eye(4)
    T_wc[:3, 3] = (0.5, 0.25, 3.0)  # right, down, forward
    message = pose_message()
    fill_pose(message, T_wc)
    assert (message.position.x, message.position.y, message.position.z) == (3.0, -0.5, -0.25)
    q = message.orientation
    R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    np.testing.assert_allclose(R @ [0, 0, 2], [2, 0, 0], atol=1e-12)
    np.testing.assert_allclose(R @ [0, -1, 0], [0, 0, 1], atol=1e-12)


def test_mask_survives_a_round_trip() -> None:
    mask = np.random.default_rng(1).random((5, 7)) < 0.5
    message = SimpleNamespace()
    fill_mask(message, mask)
    np.testing.assert_array_equal(rgb_from_message(message)[..., 0] > 0, mask)
    assert set(message.data) == {0, 255}


def test_stamp_is_converted_to_seconds() -> None:
    assert to_seconds(SimpleNamespace(sec=1_700_000_000, nanosec=250_000_000)) == 1_700_000_000.25


# ---- the node


class Message:
    """Message of any type, with fields that are made on access."""

    def __getattr__(self, name: str) -> "Message":
        if name.startswith("__"):
            raise AttributeError(name)
        self.__dict__[name] = Message()
        return self.__dict__[name]  # type: ignore[no-any-return]


class Publisher:
    """Stand-in for a publisher, which collects the messages."""

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.publish = self.sent.append


class Node:
    """Stand-in for rclpy.node.Node."""

    parameters: ClassVar[dict[str, Any]] = {}

    def __init__(self, name: str) -> None:
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.publishers: dict[str, Publisher] = {}

    def declare_parameter(self, name: str, value: Any) -> SimpleNamespace:
        return SimpleNamespace(value=self.parameters.get(name, value))

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[[Any], None], qos: Any
    ) -> None:
        self.callbacks[topic] = callback

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Publisher:
        return self.publishers.setdefault(topic, Publisher())

    def destroy_node(self) -> None: ...


class Synchronizer:
    """Stand-in for message_filters' synchronizer."""

    def __init__(self, inputs: list[Any], size: int, slop: float) -> None: ...

    def registerCallback(self, callback: Callable[[Any, Any], None]) -> None:  # noqa: N802 - ROS's name
        self.callback = callback


def drive(node: Any) -> None:
    """Send frames, each after the pose of the one before, then Ctrl-C; replaces rclpy.spin."""
    node.callbacks["color/camera_info"](info())
    answered = threading.Event()
    node.publishers["pose"].publish = lambda m: (
        node.publishers["pose"].sent.append(m),
        answered.set(),
    )
    for index, T_wc in enumerate(camera_path(FRAMES)):
        rgb, depth, _ = render(room(), T_wc)
        color = image("bgr8", rgb[..., ::-1])
        color.header = SimpleNamespace(
            stamp=SimpleNamespace(sec=5, nanosec=index * 33_000_000), frame_id="optical"
        )
        node._pairs.callback(color, image("16UC1", (depth * 1000).astype(np.uint16)))
        assert answered.wait(20)
        answered.clear()
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Load tools/ros2/cohdc_slam_node.py with stand-ins for the modules of ROS 2."""
    contents: dict[str, dict[str, Any]] = {
        "rclpy": {"init": lambda **_: None, "spin": drive, "try_shutdown": lambda: None},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO=0)},
        "message_filters": {
            "Subscriber": lambda *_, **__: None,
            "ApproximateTimeSynchronizer": Synchronizer,
        },
        "geometry_msgs": {},
        "geometry_msgs.msg": {"PoseStamped": Message},
        "nav_msgs": {},
        "nav_msgs.msg": {"Path": Message},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"CameraInfo": Message, "Image": Message},
    }
    for name, members in contents.items():
        module = ModuleType(name)
        module.__dict__.update(members)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return load_tool("ros2/cohdc_slam_node.py")


def test_node_publishes_poses_and_writes_results(
    ros: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes = []

    class RecordedNode(ros.SlamNode):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            super().__init__()
            nodes.append(self)

    monkeypatch.setattr(ros, "SlamNode", RecordedNode)
    settings = tmp_path / "settings.yaml"
    settings.write_text("features:\n  max_keypoints: 400\n")
    parameters = {"out": str(tmp_path / "run"), "settings": str(settings)}
    monkeypatch.setattr(Node, "parameters", parameters)
    ros.main()
    sent = {topic: publisher.sent for topic, publisher in nodes[0].publishers.items()}
    assert len(sent["pose"]) == FRAMES
    assert sent["pose"][3].header.frame_id == "map"
    assert sent["pose"][3].header.stamp.nanosec == 3 * 33_000_000
    assert len(sent["path"]) >= 1
    assert sent["mask"] == []
    truth = camera_path(FRAMES)[-1]
    last = sent["pose"][-1].pose.position
    np.testing.assert_allclose([-last.y, -last.z, last.x], truth[:3, 3], atol=0.01)
    assert len(Trajectory.load_tum(tmp_path / "run" / "trajectory.txt")) == FRAMES


def test_newest_frame_replaces_the_waiting_one(
    ros: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros, "POLL_S", 0.01)
    node = ros.SlamNode()
    for second in (1, 2, 3):
        color = image("rgb8", np.full((2, 2, 3), second, np.uint8))
        color.header = SimpleNamespace(stamp=SimpleNamespace(sec=second, nanosec=0))
        node._put(color, image("32FC1", np.ones((2, 2), np.float32)))
    frames = node.frames()
    first = next(frames)
    assert first is not None
    assert first[2] == 3.0
    assert next(frames) is None, "no second frame waits"
