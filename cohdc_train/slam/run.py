"""`cohdc slam` and `run_slam`: a sequence or a camera in, a trajectory and its scores out."""

import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cohdc_train.errors import DataError
from cohdc_train.slam.config import SlamConfig
from cohdc_train.slam.dynamics.mask_sources import MaskFolder, SegmenterMasks, no_masks
from cohdc_train.slam.frame import PoseCallback
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.live import stop_on_sigint
from cohdc_train.slam.io.results import (
    check_output_dir,
    compute_metrics,
    move_into_place,
    write_run,
)
from cohdc_train.slam.io.sequence import open_source
from cohdc_train.slam.io.sources import FrameSource
from cohdc_train.slam.run_config import run_config
from cohdc_train.slam.run_options import RunOptions
from cohdc_train.slam.runner import RunObserver, TrackedSequence, track_sequence
from cohdc_train.slam.runtime.threads import single_threaded
from cohdc_train.slam.runtime.workers import RealtimeWorkers, start_workers
from cohdc_train.slam.summary import summary
from cohdc_train.slam.system import Slam
from cohdc_train.slam.visualization.map_files import MapFiles
from cohdc_train.slam.visualization.rerun_viewer import RerunViewer
from cohdc_train.trajectory.trajectory import read_tum


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
        DataError: the input cannot be used, or no frame comes; one line that names file and number.
    """
    if model is not None and masks is not None:
        raise DataError("give --model or --masks, not both")
    check_output_dir(out, options.dense_cloud)
    words: dict[str, object] = {}
    if isinstance(source, Path):
        words["sequence"] = str(source)
        source = open_source(
            source, options.camera, settings.stereo, options.follow, options.idle_timeout
        )
    truth = None if source.groundtruth is None else read_tum(source.groundtruth)
    make_masks = _mask_source(model, masks, source.camera, settings, options.realtime)
    with (
        single_threaded(),
        tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder,
    ):
        part = Path(folder)
        with ExitStack() as stack:
            workers = None
            if options.realtime:
                workers = stack.enter_context(
                    start_workers(source, make_masks, settings.realtime)
                )
            slam_system = _build_slam(source.camera, settings, workers)
            files = stack.enter_context(
                MapFiles(source.camera, part, options.dense_cloud, settings.dense_cloud)
            )
            watching: list[RunObserver] = [files, *observers]
            if options.viewer or options.rrd is not None:
                viewer = RerunViewer(source.camera, options.viewer, options.rrd)
                watching.append(stack.enter_context(viewer))
            stack.enter_context(stop_on_sigint(source))
            tracked = track_sequence(
                slam_system,
                workers.source if workers else source,
                workers.mask_of if workers else make_masks or no_masks,
                part / "pictures",
                watching,
                workers.report_latency(on_pose) if workers else on_pose,
            )
            files.write(slam_system.map, tracked.trajectory)
        metrics: dict[str, Any] = {
            "seed": settings.seed,
            "realtime": options.realtime,
            "loops": slam_system.num_loops,
            "without_depth": source.num_unpaired,
            "keyframes_in_map": len(slam_system.map.keyframes),
        }
        dropped = workers.source.dropped if workers else 0
        metrics |= compute_metrics(tracked.records, tracked.trajectory, truth, dropped)
        metrics |= workers.metrics() if workers else {}
        config = run_config(words, out, model, masks, settings, options)
        write_run(part, tracked.records, tracked.trajectory, metrics, config)
        move_into_place(part, out)
    print(f"{summary(metrics)}\nwritten to {out}")
    return metrics
