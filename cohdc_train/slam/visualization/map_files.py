"""The map a run leaves: map.ply and its picture map.png, and with the dense cloud cloud.ply."""

from contextlib import ExitStack
from pathlib import Path
from typing import Self

import cv2

from cohdc_train.files import write_bytes
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import inverse
from cohdc_train.slam.io.ply import write_ply
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.visualization.depth_fusion import KeyframeImages, fuse
from cohdc_train.slam.visualization.point_cloud import PointColorRecorder
from cohdc_train.slam.visualization.top_view import render_top_view
from cohdc_train.trajectory.trajectory import Trajectory

_VOXEL = 0.01  # m


class MapFiles:
    """Watches a run for what its map's files need beside the map. folder: where they go; cloud:
    whether cloud.ply.
    """

    def __init__(self, camera: Camera, folder: Path, cloud: bool) -> None:
        self._folder = folder
        self._colors = PointColorRecorder()
        self._open = ExitStack()
        self._images = self._open.enter_context(KeyframeImages(camera, folder)) if cloud else None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def __call__(self, frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        """Note colours of points, and keep the pictures of keyframes for the cloud."""
        self._colors(frame, result, point_map)
        if self._images is not None:
            self._images(frame, result, point_map)

    def write(self, point_map: Map, trajectory: Trajectory) -> None:
        """Write the files, with keyframes and points where the map has them now.

        trajectory: of all tracked frames, keyframes that left the map too.
        """
        cloud = self._colors.cloud(point_map)
        write_ply(self._folder / "map.ply", cloud.points, cloud.colors)
        if self._images is not None:
            T_cw = inverse(trajectory.poses)
            frames = dict(zip(trajectory.stamps.tolist(), T_cw, strict=True))
            cloud = fuse(self._images, frames, point_map.camera, _VOXEL)
            write_ply(self._folder / "cloud.ply", cloud.points, cloud.colors)
        if len(trajectory):
            image = render_top_view(cloud, list(trajectory.poses))
            bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
            write_bytes(self._folder / "map.png", cv2.imencode(".png", bgr)[1].tobytes())
