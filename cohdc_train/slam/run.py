"""Run of a sequence or a camera through SLAM: `cohdc slam` and `run_slam`."""

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from cohdc_train import __version__
from cohdc_train.errors import DataError
from cohdc_train.slam.config import SlamConfig, as_plain
from cohdc_train.slam.dynamics.mask_sources import MaskFolder, SegmenterMasks, no_masks
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.frame import PoseCallback
from cohdc_train.slam.geometry.calibration import choose_camera
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.growing_sequence import GrowingSequence
from cohdc_train.slam.io.live import stop_on_sigint
from cohdc_train.slam.io.results import (
    ANIMATION,
    DENSE_CLOUD,
    check_output_dir,
    compute_metrics,
    format_summary,
    move_into_place,
    write_run,
)
from cohdc_train.slam.io.sequence import choose_format
from cohdc_train.slam.io.sources import FrameSource, RecordedSequence
from cohdc_train.slam.runner import RunObserver, TrackedSequence, track_sequence
from cohdc_train.slam.runtime.threads import single_threaded
from cohdc_train.slam.runtime.workers import RealtimeWorkers, start_workers
from cohdc_train.slam.system import Slam
from cohdc_train.slam.visualization.animation import RunAnimation
from cohdc_train.slam.visualization.map_files import MapFiles
from cohdc_train.slam.visualization.rerun_viewer import RerunViewer
from cohdc_train.slam.visualization.worst_frames import WorstFrames
from cohdc_train.trajectory.trajectory import Trajectory

# Options of earlier versions, for which `cohdc slam` prints the current name.
RENAMED_OPTIONS = {
    "--sequence": "the first argument, cohdc slam SEQUENCE,",
    "--seed": "--settings.seed",
    "--features": "--settings.features.max_keypoints",
    "--cloud": "--dense_cloud",
    "--idle": "--idle_timeout",
    "--view": "--viewer",
    "--culling.dynamic_classes": "--settings.masks.dynamic_classes",
    "--culling.score": "--settings.masks.min_score",
    "--culling.quality": "--settings.masks.min_quality",
    "--culling.dilate": "--settings.masks.dilation_px",
    "--culling.doubt": "--settings.masks.quality_dilation",
    "--method.loops": "--settings.loops.enabled",
    "--method.refinement": "--settings.refinement.enabled",
    "--method.geometry": "--settings.free_space.enabled",
    "--method.static_weights": "--settings.motion_segmentation.enabled",
    "--method.global_adjustment": "--settings.bundle_adjustment.global_enabled",
    "--method.every_frame": "--settings.bundle_adjustment.use_all_frames",
    "--method.smoothing": "--settings.smoothing.enabled",
    "--method.keyframe_culling": "--settings.keyframe_culling.enabled",
    "--method.flow": "--settings.flow.enabled",
}


@dataclass(frozen=True)
class RunOptions:
    """Options of a run, in addition to its input and the settings of the SLAM system.

    Args:
        camera: camera YAML; by default camera.yaml of the sequence, or a guess from the folder's
            name.
        realtime: take frames at the pace of their timestamps, and drop delayed ones; masks and
            mapping run in parallel with tracking. Results then depend on the machine.
        dense_cloud: write cloud.ply too, the dense colored points of all static surfaces.
        animation: write animation.webp too: keypoints, dynamic mask, and trajectory side by side.
        follow: the sequence is still being written: take frames as its lists grow.
        idle_timeout: seconds without a new frame after which a followed sequence has ended; a file
            named done in its folder ends it, too.
        viewer: show the run in rerun's window; needs `pip install 'cohdc-train[view]'`.
        rrd: file to record the same for rerun.
    """

    camera: Path | None = None
    realtime: bool = False
    dense_cloud: bool = False
    animation: bool = False
    follow: bool = False
    idle_timeout: float = 10.0
    viewer: bool = False
    rrd: Path | None = None

    def __post_init__(self) -> None:
        if not 0 < self.idle_timeout < float("inf"):
            raise DataError(f"idle_timeout is {self.idle_timeout:g}; allowed: above 0")

    def extra_files(self) -> list[str]:
        """Return the names of the files that are written on request only."""
        wanted = {DENSE_CLOUD: self.dense_cloud, ANIMATION: self.animation}
        return [name for name, is_wanted in wanted.items() if is_wanted]


def slam(
    sequence: Path,
    *,
    out: Path,
    model: Path | None = None,
    masks: Path | None = None,
    settings: SlamConfig = SlamConfig(),
    **options: Any,
) -> dict[str, Any]:
    """Track an RGB-D camera or a stereo pair through a TUM-format sequence with moving people.

    People are excluded by masks or a model. Writes trajectory.txt (TUM format, every tracked
    frame), metrics.json, frames.csv, config.yaml, map.ply, map.png, and pictures/ into the output
    folder, and returns the metrics. `--config RUN/config.yaml` repeats a run.

    Args:
        sequence: folder with rgb.txt, depth.txt, and their images, or with left.txt and right.txt
            of a rectified stereo pair whose camera YAML has a baseline; groundtruth.txt is used for
            scores.
        out: folder for the results. Files of a former run are replaced, all others stay. A folder
            that holds other files with the names of results is refused.
        model: ONNX file written by `cohdc export`, or a shipped network's name (person, person_s),
            which segments every frame.
        masks: folder of PNG masks with the names of the color images, above 0 = dynamic.
        settings: options of the SLAM system.
        options: as RunOptions.
    """
    return run_slam(
        sequence,
        out,
        model=model,
        masks=masks,
        settings=settings,
        options=RunOptions(**options),
    )


def run_slam(
    source: FrameSource | Path,
    out: Path,
    *,
    model: Path | None = None,
    masks: Path | None = None,
    settings: SlamConfig = SlamConfig(),
    options: RunOptions = RunOptions(),
    observers: Sequence[RunObserver] = (),
    on_pose: PoseCallback | None = None,
) -> dict[str, Any]:
    """Track a sequence or a camera, write the results into a folder, and return the metrics.

    One run at a time in a process, for it limits the threads of numerical libraries.

    Args:
        source: folder of a sequence as `cohdc slam` takes it, or frames, such as LiveCamera.
        out: folder for the results, as `cohdc slam` writes them.
        model: ONNX file or shipped network that segments every frame; not together with masks.
        masks: folder of PNG masks.
        settings: options of the SLAM system.
        options: real time, outputs, and how a folder is read.
        observers: called after all work on a frame; in real time up to a frame period later.
        on_pose: called with each frame's result as soon as its pose is known.

    Raises:
        DataError: the input cannot be used, or has no frames.
    """
    if model is not None and masks is not None:
        raise DataError("give --model or --masks, not both")
    check_output_dir(out, options.extra_files())
    sequence = source if isinstance(source, Path) else None
    if isinstance(source, Path):
        source = _open_folder(source, settings, options)
    truth = None if source.groundtruth is None else Trajectory.load_tum(source.groundtruth)
    make_masks = _mask_source(model, masks, source.camera, settings, options.realtime)
    with (
        single_threaded(),
        tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder,
    ):
        part = Path(folder)
        with ExitStack() as stack:
            workers = None
            if options.realtime:
                parallel = start_workers(source, make_masks, settings.masks, settings.realtime)
                workers = stack.enter_context(parallel)
            slam_system = _build_slam(source.camera, settings, workers)
            files = stack.enter_context(_map_files(source.camera, part, settings, options))
            worst_frames = WorstFrames()
            animations = _animations(part, source.camera, settings, options)
            viewers = _open_viewer(stack, source.camera, files, options)
            stack.enter_context(stop_on_sigint(source))
            tracked = track_sequence(
                slam_system,
                workers.source if workers else source,
                workers.mask_of if workers else make_masks or no_masks,
                part / "pictures",
                [files, worst_frames, *animations, *observers, *viewers],
                workers.report_latency(on_pose) if workers else on_pose,
            )
            files.write(slam_system.map, tracked.trajectory)
            worst_frames.write(part / "pictures")
            for animation in animations:
                animation.write(tracked.trajectory, truth)
        metrics = _metrics(slam_system, tracked, workers, truth, source.num_unpaired)
        inputs = {"sequence": sequence, "model": model, "masks": masks}
        config = _config_text(inputs, source.camera, settings, options)
        write_run(part, tracked.records, tracked.trajectory, metrics, config)
        move_into_place(part, out)
    print(f"{format_summary(metrics)}\nwritten to {out}")
    return metrics


def _open_folder(folder: Path, settings: SlamConfig, options: RunOptions) -> FrameSource:
    """Open the folder of a sequence, and print what is read."""
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder")
    camera, origin = choose_camera(folder, options.camera)
    print(f"camera: {origin}")
    form = choose_format(folder, camera, settings.stereo)
    if options.follow:
        end = f"a file {folder / 'done'} or Ctrl-C ends it"
        print(f"sequence: {form.first} and {form.second} as they grow; {end}")
        return GrowingSequence(folder, camera, form, options.idle_timeout)
    source = RecordedSequence(folder, camera, form)
    skipped = f"{source.num_unpaired} images without a partner are skipped"
    print(f"sequence: {len(source)} pairs; {skipped}")
    return source


def _mask_source(
    model: Path | None, masks: Path | None, camera: Camera, settings: SlamConfig, realtime: bool
) -> MaskFolder | SegmenterMasks | None:
    """Return the source of masks; in real time the segmenter runs on one thread."""
    if masks is not None:
        return MaskFolder(masks, camera, settings.masks)
    if model is None:
        return None
    from cohdc_train.segmenter import Segmenter

    return SegmenterMasks(Segmenter(model, 1 if realtime else 0), settings.masks)


def _map_files(camera: Camera, folder: Path, settings: SlamConfig, options: RunOptions) -> MapFiles:
    """Return the writer of the map's files."""
    max_depth_m = settings.depth.limit_m(camera.baseline)
    return MapFiles(camera, folder, options.dense_cloud, max_depth_m, settings.dense_cloud)


def _build_slam(camera: Camera, settings: SlamConfig, workers: RealtimeWorkers | None) -> Slam:
    """Build the SLAM system, with the workers in real time."""
    if workers is None:
        return Slam(camera, settings)
    return Slam(
        camera,
        settings,
        executor=workers.executor,
        frame_time_used=workers.source.frame_time_used,
    )


def _open_viewer(
    stack: ExitStack, camera: Camera, files: MapFiles, options: RunOptions
) -> list[RunObserver]:
    """Open the viewer if requested."""
    if not options.viewer and options.rrd is None:
        return []
    viewer = RerunViewer(camera, files.colors, options.viewer, options.rrd)
    return [stack.enter_context(viewer)]


def _animations(
    part: Path, camera: Camera, settings: SlamConfig, options: RunOptions
) -> list[RunAnimation]:
    """Return the observer that draws animation.webp, none if not requested."""
    if not options.animation:
        return []
    return [RunAnimation(part / ANIMATION, OrbExtractor(camera, settings.features))]


def _metrics(
    slam_system: Slam,
    tracked: TrackedSequence,
    workers: RealtimeWorkers | None,
    truth: Trajectory | None,
    num_unpaired: int,
) -> dict[str, Any]:
    """Return the content of metrics.json."""
    metrics: dict[str, Any] = {
        "seed": slam_system.config.seed,
        "realtime": workers is not None,
        "loops": slam_system.num_loops,
        "without_depth": num_unpaired,
        "keyframes_in_map": len(slam_system.map.keyframes),
    }
    dropped = 0 if workers is None else workers.source.dropped
    metrics |= compute_metrics(tracked.records, tracked.trajectory, truth, dropped)
    if workers is not None:
        # Masks are propagated to each frame; the segmenter's own time is segmenter_ms.
        stages = metrics["ms"].items()
        metrics["ms"] = {"mask" if name == "segment" else name: ms for name, ms in stages}
        metrics |= workers.metrics()
    return metrics


def _config_text(
    inputs: dict[str, Path | None], camera: Camera, settings: SlamConfig, options: RunOptions
) -> str:
    """Return config.yaml, which `cohdc slam --config` reads; version and camera are comments."""
    content = {name: None if path is None else str(path) for name, path in inputs.items()}
    content |= as_plain(asdict(options)) | {"settings": as_plain(asdict(settings))}
    intrinsics = " ".join(f"{name}={value:g}" for name, value in camera.as_dict().items())
    head = f"# cohdc {__version__}\n# camera: {intrinsics}\n"
    return head + yaml.safe_dump(content, sort_keys=False)
