#!/usr/bin/env python3
"""A ROS 2 node around the SLAM runner: color and aligned depth in; pose, path and mask out.

    tools/ros2/cohdc_slam_node.py --ros-args -p model:=person -p out:=runs/robot \
        -r color/image:=/camera/color/image_raw -r color/camera_info:=/camera/color/camera_info \
        -r depth/image:=/camera/aligned_depth_to_color/image_raw

Needs rclpy, message_filters, sensor_msgs, geometry_msgs and nav_msgs of a ROS 2 installation, and
cohdc-train in the same Python. Publishes, in the frame `map` (x forward, y left, z up where the
first camera stood): pose (geometry_msgs/PoseStamped) per tracked frame, path (nav_msgs/Path) of the
keyframes at every new one, and mask (sensor_msgs/Image, mono8, 255 = dynamic). A frame that comes
while another is worked on replaces the one that waits. Ctrl-C ends it and writes what `cohdc slam`
writes into `out`.

Parameters: model (ONNX or a shipped network's name; empty: no masks), out, cloud (true: cloud.ply
too), seed, features.
"""

import queue
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import message_filters
import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, Image

from cohdc_train.slam.config import MAX_KEYPOINTS
from cohdc_train.slam.frame import FrameRecord, Pose, View
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.live import Frame, Live
from cohdc_train.slam.io.ros import camera_of, depth_of, fill_mask, fill_pose, rgb_of, seconds
from cohdc_train.slam.run import run_source
from cohdc_train.slam.tracking.tracker import Tracker

SLOP = 0.02  # s between the stamps of color and depth
WAIT = 0.2  # s between two looks at whether to stop


class SlamNode(Node):
    """Frames from topics for `run_source`, and the watcher that publishes what became of them."""

    def __init__(self) -> None:
        super().__init__("cohdc_slam")
        self._frames: queue.Queue[tuple[Any, Any]] = queue.Queue(maxsize=1)
        self._infos: queue.Queue[Any] = queue.Queue()
        self._headers: dict[float, Any] = {}
        topics = ("color/image", "depth/image")
        inputs = [
            message_filters.Subscriber(self, Image, name, qos_profile=qos_profile_sensor_data)
            for name in topics
        ]
        self._pairs = message_filters.ApproximateTimeSynchronizer(inputs, 10, SLOP)
        self._pairs.registerCallback(self._take)
        self.create_subscription(
            CameraInfo, "color/camera_info", self._infos.put, qos_profile_sensor_data
        )
        self._pose = self.create_publisher(PoseStamped, "pose", 10)
        self._path = self.create_publisher(PathMessage, "path", 1)
        self._mask = self.create_publisher(Image, "mask", 1)

    def options(self) -> dict[str, Any]:
        """Arguments of run_source from the node's parameters."""
        defaults = {
            "model": "",
            "out": "runs/ros",
            "cloud": False,
            "seed": 0,
            "features": MAX_KEYPOINTS,
        }
        values = {
            name: self.declare_parameter(name, default).value for name, default in defaults.items()
        }
        return values | {
            "out": Path(values["out"]),
            "model": Path(values["model"]) if values["model"] else None,
        }

    def camera(self) -> Camera:
        """The camera, as soon as it is told."""
        while True:
            try:
                return camera_of(self._infos.get(timeout=WAIT))
            except queue.Empty:
                continue

    def frames(self) -> Iterator[Frame | None]:
        """Frames as they come; None while none does."""
        while True:
            try:
                color, depth = self._frames.get(timeout=WAIT)
            except queue.Empty:
                yield None
                continue
            t = seconds(color.header.stamp)
            self._headers[t] = color.header
            yield rgb_of(color), depth_of(depth), t

    def _take(self, color: Any, depth: Any) -> None:
        while True:
            try:
                return self._frames.put_nowait((color, depth))
            except queue.Full:  # the newest frame counts
                try:
                    self._frames.get_nowait()
                except queue.Empty:
                    continue

    def on_pose(self, pose: Pose) -> None:
        """Publish one frame's pose, before its share of mapping is done."""
        if pose.T_wc is not None:
            self._pose.publish(stamped(pose.T_wc, self._headers[pose.t].stamp))

    def __call__(
        self, view: View, mask: NDArray[np.bool_] | None, record: FrameRecord, tracker: Tracker
    ) -> None:
        """Publish one frame's mask, and the path when it has grown."""
        header = self._headers.pop(view.t)
        if record.pose.keyframe:
            path = PathMessage()
            path.header.stamp, path.header.frame_id = header.stamp, "map"
            path.poses = [stamped(T_wc, header.stamp) for T_wc in tracker.map.way()]
            self._path.publish(path)
        if mask is not None:
            message = Image()
            message.header = header
            fill_mask(message, mask)
            self._mask.publish(message)


def stamped(T_wc: NDArray[np.float64], stamp: Any) -> PoseStamped:
    """A pose in the frame `map`."""
    message = PoseStamped()
    message.header.stamp, message.header.frame_id = stamp, "map"
    fill_pose(message.pose, T_wc)
    return message


def main() -> None:
    """Spin beside, track here: Ctrl-C belongs to run_source."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = SlamNode()
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    try:
        options = node.options()
        run_source(
            Live(node.camera(), node.frames()), observers=[node], on_pose=node.on_pose, **options
        )
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
