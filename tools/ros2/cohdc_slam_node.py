#!/usr/bin/env python3
"""ROS 2 node around the SLAM runner: color and aligned depth in; pose, path and mask out.

    tools/ros2/cohdc_slam_node.py --ros-args -p model:=person -p out:=runs/robot \
        -r color/image:=/camera/color/image_raw -r color/camera_info:=/camera/color/camera_info \
        -r depth/image:=/camera/aligned_depth_to_color/image_raw

Needs rclpy, message_filters, sensor_msgs, geometry_msgs and nav_msgs of a ROS 2 installation, and
cohdc-train in the same Python. Publishes, in the frame `map` (x forward, y left, z up where the
first camera stood): pose (geometry_msgs/PoseStamped) of each tracked frame, path (nav_msgs/Path) of
the keyframes after each new one, and mask (sensor_msgs/Image, mono8, 255 = dynamic). While a frame
is processed, a newer frame replaces one that waits. Ctrl-C ends the node, which then writes what
`cohdc slam` writes into `out`.

Parameters: model (ONNX file or a shipped network's name; empty: no masks), out, dense_cloud (true:
cloud.ply as well), and settings: a YAML file of options as config.yaml of a run has them.
"""

import queue
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import message_filters
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, Image

from cohdc_train.slam.config import SlamConfig
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import Array
from cohdc_train.slam.io.live import CameraFrame, LiveCamera
from cohdc_train.slam.io.ros import (
    camera_from_message,
    depth_from_message,
    fill_mask,
    fill_pose,
    rgb_from_message,
    to_seconds,
)
from cohdc_train.slam.io.sources import MAX_TIME_DIFFERENCE_S
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.run import RunOptions, run_slam

POLL_S = 0.2  # between two looks at whether to stop


class SlamNode(Node):
    """Node that gives frames of topics to `run_slam`, and publishes the results as its observer."""

    def __init__(self) -> None:
        """Subscribe to the camera, and advertise the results."""
        super().__init__("cohdc_slam")
        self._frames: queue.Queue[tuple[Any, Any]] = queue.Queue(maxsize=1)
        self._infos: queue.Queue[Any] = queue.Queue()
        self._headers: dict[float, Any] = {}
        topics = ("color/image", "depth/image")
        inputs = [
            message_filters.Subscriber(self, Image, name, qos_profile=qos_profile_sensor_data)
            for name in topics
        ]
        synchronizer = message_filters.ApproximateTimeSynchronizer
        self._pairs = synchronizer(inputs, 10, MAX_TIME_DIFFERENCE_S)
        self._pairs.registerCallback(self._put)
        self.create_subscription(
            CameraInfo, "color/camera_info", self._infos.put, qos_profile_sensor_data
        )
        self._pose = self.create_publisher(PoseStamped, "pose", 10)
        self._path = self.create_publisher(PathMessage, "path", 1)
        self._mask = self.create_publisher(Image, "mask", 1)

    def options(self) -> dict[str, Any]:
        """Return the arguments of `run_slam` from the node's parameters."""
        defaults = {"model": "", "out": "runs/ros", "dense_cloud": False, "settings": ""}
        values = {
            name: self.declare_parameter(name, default).value for name, default in defaults.items()
        }
        settings = values["settings"]
        return {
            "out": Path(values["out"]),
            "model": Path(values["model"]) if values["model"] else None,
            "settings": SlamConfig.from_yaml(Path(settings)) if settings else SlamConfig(),
            "options": RunOptions(dense_cloud=values["dense_cloud"]),
        }

    def camera(self) -> Camera:
        """Wait for the camera's calibration, and return it."""
        while True:
            try:
                return camera_from_message(self._infos.get(timeout=POLL_S))
            except queue.Empty:
                continue

    def frames(self) -> Iterator[CameraFrame | None]:
        """Return frames as they come; None while there is none."""
        while True:
            try:
                color, depth = self._frames.get(timeout=POLL_S)
            except queue.Empty:
                yield None
                continue
            timestamp = to_seconds(color.header.stamp)
            self._headers[timestamp] = color.header
            yield rgb_from_message(color), depth_from_message(depth), timestamp

    def _put(self, color: Any, depth: Any) -> None:
        """Let a pair of images wait, in place of an older pair."""
        while True:
            try:
                return self._frames.put_nowait((color, depth))
            except queue.Full:
                try:
                    self._frames.get_nowait()
                except queue.Empty:
                    continue

    def on_pose(self, result: FrameResult) -> None:
        """Publish the pose of a frame, before the map is extended."""
        if result.T_wc is not None:
            header = self._headers[result.timestamp]
            self._pose.publish(stamped_pose(result.T_wc, header.stamp))

    def __call__(self, frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        """Publish the mask of a frame, and the path after a keyframe."""
        header = self._headers.pop(frame.timestamp)
        if result.is_keyframe:
            path = PathMessage()
            path.header.stamp = header.stamp
            path.header.frame_id = "map"
            path.poses = [
                stamped_pose(T_wc, header.stamp) for T_wc in point_map.keyframe_trajectory()
            ]
            self._path.publish(path)
        mask = result.union_mask
        if mask is not None:
            message = Image()
            message.header = header
            fill_mask(message, mask)
            self._mask.publish(message)


def stamped_pose(T_wc: Array, stamp: Any) -> PoseStamped:
    """Return a pose in the frame `map`."""
    message = PoseStamped()
    message.header.stamp = stamp
    message.header.frame_id = "map"
    fill_pose(message.pose, T_wc)
    return message


def main() -> None:
    """Spin in a thread, and track in the main thread, where run_slam handles Ctrl-C."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = SlamNode()
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    try:
        options = node.options()
        source = LiveCamera(node.camera(), node.frames())
        run_slam(source, observers=[node], on_pose=node.on_pose, **options)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
