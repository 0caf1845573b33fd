"""A run in rerun's viewer, or in a file for it: camera, image with mask, map, way and times. Needs
the extra `view`.
"""

import os
import sys
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cohdc_train.drawing import encode_jpeg
from cohdc_train.errors import CohdcError, MissingExtraError
from cohdc_train.slam.frame import FrameRecord, View
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.tracking.tracker import Tracker
from cohdc_train.slam.visualization.point_cloud import PointColors

_LAST = 5.0  # s that rerun has for the rest when a run is over
_MEMORY = "25%"  # of the machine's, which the viewer may fill before it forgets the oldest
_FRUSTUM = 0.15  # m
_JPEG_QUALITY = 80
_MASK = (230, 40, 40)  # RGB
_WAY = (250, 160, 40)


class Viewer:
    """Watches a run and shows it. window: open rerun's viewer; file: write an .rrd for it, whole
    when the run is over.

    Raises MissingExtraError when rerun-sdk is not installed, CohdcError when its window cannot be
    opened.
    """

    def __init__(self, camera: Camera, window: bool, file: Path | None) -> None:
        try:
            import rerun
        except ModuleNotFoundError as error:
            message = "--view and --rrd need rerun-sdk, which is not installed: pip install 'cohdc-train[view]'"
            raise MissingExtraError(message) from error
        self._rerun: Any = rerun
        self._stream = rerun.RecordingStream("cohdc slam")
        self._colors = PointColors()
        self._start: float | None = None
        self._file = file
        self._open(window)
        self._describe(camera)

    def _open(self, window: bool) -> None:
        rerun, sinks = self._rerun, []
        if window:
            self._spawn()
            sinks.append(rerun.GrpcSink())
        if self._file is not None:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            sinks.append(rerun.FileSink(self._part()))
        blueprint = rerun.blueprint
        views = blueprint.Vertical(
            blueprint.Spatial2DView(origin="world/camera", name="camera"),
            blueprint.TimeSeriesView(origin="ms", name="ms"),
            blueprint.TimeSeriesView(origin="inliers", name="inliers"),
            row_shares=[3, 1, 1],
        )
        layout = blueprint.Horizontal(
            blueprint.Spatial3DView(origin="world", name="map"), views, column_shares=[3, 2]
        )
        self._stream.set_sinks(
            *sinks, default_blueprint=blueprint.Blueprint(layout, collapse_panels=True)
        )

    def _spawn(self) -> None:
        """Start the viewer, or find one that runs. pip put it beside Python, which need not be on
        the PATH.
        """
        before = os.environ.get("PATH", "")
        os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{before}"
        try:
            self._stream.spawn(connect=False, memory_limit=_MEMORY, hide_welcome_screen=True)
        except RuntimeError as error:
            reason = str(error).partition("\n")[0]
            raise CohdcError(f"--view: rerun's window cannot be opened: {reason}") from error
        finally:
            os.environ["PATH"] = before

    def _part(self) -> Path:
        assert self._file is not None
        return self._file.with_name(self._file.name + ".part")

    def _describe(self, camera: Camera) -> None:
        rerun, log = self._rerun, self._stream.log
        log("world", rerun.ViewCoordinates.RDF, static=True)
        pinhole = rerun.Pinhole(
            image_from_camera=camera.matrix(),
            resolution=[camera.width, camera.height],
            camera_xyz=rerun.ViewCoordinates.RDF,
            image_plane_distance=_FRUSTUM,
        )
        log("world/camera", pinhole, static=True)
        log("world/camera/mask", rerun.AnnotationContext([(1, "dynamic", _MASK)]), static=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            self._stream.flush(timeout_sec=_LAST)
        except RuntimeError as error:  # a window that was closed costs no results
            print(f"rerun did not get everything: {error}", file=sys.stderr)
        self._stream.disconnect()
        if self._file is not None and kind is None:
            os.replace(self._part(), self._file)
        elif self._file is not None:
            self._part().unlink(missing_ok=True)

    def __call__(
        self, view: View, mask: NDArray[np.bool_] | None, record: FrameRecord, tracker: Tracker
    ) -> None:
        """Show a frame; the map and the way when it became a keyframe."""
        rerun, log, pose = self._rerun, self._stream.log, record.pose
        self._start = view.t if self._start is None else self._start
        self._stream.set_time("time", duration=view.t - self._start)
        if pose.T_wc is not None:
            log(
                "world/camera",
                rerun.Transform3D(translation=pose.T_wc[:3, 3], mat3x3=pose.T_wc[:3, :3]),
            )
        jpeg = encode_jpeg(view.rgb, _JPEG_QUALITY)
        log("world/camera/image", rerun.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        if mask is not None:
            log("world/camera/mask", rerun.SegmentationImage(mask.astype(np.uint8), opacity=0.5))
        times = {
            "segment": record.segment_ms,
            "track": pose.track_ms,
            "map": pose.map_ms,
            "depth": record.depth_ms,
        }
        for stage, ms in times.items():
            if ms > 0:
                log(f"ms/{stage}", rerun.Scalars(ms))
        log("inliers", rerun.Scalars(pose.inliers))
        self._colors(view, mask, record, tracker)
        if pose.keyframe:
            cloud = self._colors.cloud(tracker.map)
            log("world/points", rerun.Points3D(cloud.points, colors=cloud.colors, radii=0.006))
            log("world/way", rerun.LineStrips3D([tracker.map.way()[:, :3, 3]], colors=[_WAY]))
