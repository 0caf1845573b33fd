"""Files of the final map: map.ply, its image map.png, and the dense cloud.ply."""

from contextlib import ExitStack
from pathlib import Path
from typing import Self

import cv2

from cohdc_train.files import write_bytes
from cohdc_train.slam.config import DenseCloudConfig
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.geometry.se3 import inverse
from cohdc_train.slam.io.ply import write_ply
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.visualization.depth_fusion import KeyframeImages, fuse_depth_images
from cohdc_train.slam.visualization.point_cloud import PointCloud, PointColorRecorder
from cohdc_train.slam.visualization.top_view import render_top_view
from cohdc_train.trajectory.trajectory import Trajectory


class MapFiles:
    """Observer of a run that records what the files of its map need.

    Attributes:
        colors: of the map points.
    """

    def __init__(
        self,
        camera: Camera,
        folder: Path,
        is_dense: bool,
        max_depth_m: float,
        config: DenseCloudConfig = DenseCloudConfig(),
    ) -> None:
        """Start to record.

        Args:
            camera: of the frames.
            folder: where the files go.
            is_dense: write cloud.ply as well; the images of keyframes are then stored on disk
                until the `with` block ends.
            max_depth_m: largest depth in the dense cloud, m.
            config: of both clouds.
        """
        self.colors = PointColorRecorder(config)
        self._camera = camera
        self._folder = folder
        self._max_depth_m = max_depth_m
        self._config = config
        self._stack = ExitStack()
        self._images: KeyframeImages | None = None
        if is_dense:
            images = KeyframeImages(camera, folder, max_depth_m, config)
            self._images = self._stack.enter_context(images)

    def __enter__(self) -> Self:
        """Return the recorder."""
        return self

    def __exit__(self, *_: object) -> None:
        """Delete the stored images."""
        self._stack.close()

    def __call__(self, frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        """Record the colors of points and, for the dense cloud, the images of keyframes."""
        self.colors(frame, result, point_map)
        if self._images is not None:
            self._images(frame, result, point_map)

    def write(self, point_map: Map, trajectory: Trajectory) -> None:
        """Write the files.

        Args:
            point_map: of the run, final.
            trajectory: of all tracked frames, among them keyframes that left the map.
        """
        cloud = self.colors.cloud(point_map)
        write_ply(self._folder / "map.ply", cloud.points, cloud.colors)
        if self._images is not None:
            cloud = self._fuse(self._images, trajectory)
            write_ply(self._folder / "cloud.ply", cloud.points, cloud.colors)
        if len(trajectory):
            image = render_top_view(cloud, list(trajectory.poses))
            bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
            write_bytes(self._folder / "map.png", cv2.imencode(".png", bgr)[1].tobytes())

    def _fuse(self, images: KeyframeImages, trajectory: Trajectory) -> PointCloud:
        """Return the dense cloud."""
        T_cw = inverse(trajectory.poses)
        poses = dict(zip(trajectory.timestamps.tolist(), T_cw, strict=True))
        return fuse_depth_images(images, poses, self._camera, self._max_depth_m, self._config)
