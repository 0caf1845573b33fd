"""Viewer of a run with rerun, in a window or in a file; needs the extra `view`."""

import os
import sys
from pathlib import Path
from typing import Any, Self

from cohdc_train.drawing import encode_jpeg
from cohdc_train.errors import CohdcError, MissingExtraError
from cohdc_train.slam.frame import FrameResult, RGBDFrame
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.mapping.map import Map
from cohdc_train.slam.visualization.point_cloud import PointColorRecorder

_FLUSH_TIMEOUT_S = 5.0
_MEMORY_LIMIT = "25%"  # of the machine's memory, before the viewer forgets the oldest data
_FRUSTUM_M = 0.15
_POINT_RADIUS_M = 0.006
_JPEG_QUALITY = 80
_MASK_COLOR = (230, 40, 40)  # RGB
_PATH_COLOR = (250, 160, 40)


class RerunViewer:
    """Observer of a run that shows it in rerun: camera, image, mask, map, path and times."""

    def __init__(
        self, camera: Camera, colors: PointColorRecorder, window: bool, file: Path | None
    ) -> None:
        """Open the viewer.

        Args:
            camera: of the frames.
            colors: of the map points; an observer of the same run, called before this one.
            window: open rerun's window.
            file: write an .rrd file, which is complete when the `with` block ends.

        Raises:
            MissingExtraError: rerun-sdk is not installed.
            CohdcError: the window cannot be opened.
        """
        try:
            import rerun
        except ModuleNotFoundError as error:
            problem = "--viewer and --rrd need rerun-sdk, which is not installed"
            raise MissingExtraError(f"{problem}: pip install 'cohdc-train[view]'") from error
        self._rerun: Any = rerun
        self._stream = rerun.RecordingStream("cohdc slam")
        self._colors = colors
        self._start: float | None = None
        self._file = file
        # The file gets its name when it is complete.
        self._part = None if file is None else file.with_name(file.name + ".part")
        self._open(window)
        self._log_camera(camera)

    def _open(self, window: bool) -> None:
        """Open window and file, and arrange the views."""
        rerun, sinks = self._rerun, []
        if window:
            self._spawn()
            sinks.append(rerun.GrpcSink())
        if self._part is not None:
            self._part.parent.mkdir(parents=True, exist_ok=True)
            sinks.append(rerun.FileSink(self._part))
        blueprint = rerun.blueprint
        views = blueprint.Vertical(
            blueprint.Spatial2DView(origin="world/camera", name="camera"),
            blueprint.TimeSeriesView(origin="ms", name="ms"),
            blueprint.TimeSeriesView(origin="inliers", name="inliers"),
            row_shares=[3, 1, 1],
        )
        map_view = blueprint.Spatial3DView(origin="world", name="map")
        layout = blueprint.Horizontal(map_view, views, column_shares=[3, 2])
        default = blueprint.Blueprint(layout, collapse_panels=True)
        self._stream.set_sinks(*sinks, default_blueprint=default)

    def _spawn(self) -> None:
        """Start the viewer, or find one that runs."""
        before = os.environ.get("PATH", "")
        # pip installs the viewer beside Python, which need not be on the PATH.
        os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{before}"
        try:
            self._stream.spawn(connect=False, memory_limit=_MEMORY_LIMIT, hide_welcome_screen=True)
        except RuntimeError as error:
            reason = str(error).partition("\n")[0]
            raise CohdcError(f"--viewer: rerun's window cannot be opened: {reason}") from error
        finally:
            os.environ["PATH"] = before

    def _log_camera(self, camera: Camera) -> None:
        """Log what does not change: axes, intrinsics, and the color of masks."""
        rerun, log = self._rerun, self._stream.log
        log("world", rerun.ViewCoordinates.RDF, static=True)
        pinhole = rerun.Pinhole(
            image_from_camera=camera.matrix(),
            resolution=[camera.width, camera.height],
            camera_xyz=rerun.ViewCoordinates.RDF,
            image_plane_distance=_FRUSTUM_M,
        )
        log("world/camera", pinhole, static=True)
        classes = rerun.AnnotationContext([(1, "dynamic", _MASK_COLOR)])
        log("world/camera/mask", classes, static=True)

    def __enter__(self) -> Self:
        """Return the viewer."""
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """Send the rest, and keep the file unless the run has failed."""
        try:
            self._stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except RuntimeError as error:  # a closed window must not cost the results
            print(f"rerun did not receive everything: {error}", file=sys.stderr)
        self._stream.disconnect()
        if self._file is None or self._part is None:
            return
        if kind is None:
            os.replace(self._part, self._file)
        else:
            self._part.unlink(missing_ok=True)

    def __call__(self, frame: RGBDFrame, result: FrameResult, point_map: Map) -> None:
        """Show a frame, and the map and the path after a keyframe."""
        self._start = frame.timestamp if self._start is None else self._start
        self._stream.set_time("time", duration=frame.timestamp - self._start)
        self._log_frame(frame, result)
        self._log_times(result)
        if result.is_keyframe:
            self._log_map(point_map)

    def _log_frame(self, frame: RGBDFrame, result: FrameResult) -> None:
        """Log pose, color image and mask."""
        rerun, log, T_wc, mask = self._rerun, self._stream.log, result.T_wc, result.union_mask
        if T_wc is not None:
            log("world/camera", rerun.Transform3D(translation=T_wc[:3, 3], mat3x3=T_wc[:3, :3]))
        jpeg = encode_jpeg(frame.rgb, _JPEG_QUALITY)
        log("world/camera/image", rerun.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        if mask is not None:
            log("world/camera/mask", rerun.SegmentationImage(mask.astype("uint8"), opacity=0.5))

    def _log_times(self, result: FrameResult) -> None:
        """Log the stages' times and the number of inliers."""
        rerun, log, timing = self._rerun, self._stream.log, result.timing
        times = {
            "segment": timing.mask_ms,
            "track": timing.tracking_ms,
            "map": timing.mapping_ms,
            "depth": timing.depth_ms,
        }
        for stage, ms in times.items():
            if ms > 0:
                log(f"ms/{stage}", rerun.Scalars(ms))
        log("inliers", rerun.Scalars(result.num_inliers))

    def _log_map(self, point_map: Map) -> None:
        """Log the map points and the path of the keyframes."""
        rerun, log = self._rerun, self._stream.log
        cloud = self._colors.cloud(point_map)
        points = rerun.Points3D(cloud.points, colors=cloud.colors, radii=_POINT_RADIUS_M)
        log("world/points", points)
        path = point_map.keyframe_trajectory()[:, :3, 3]
        log("world/trajectory", rerun.LineStrips3D([path], colors=[_PATH_COLOR]))
