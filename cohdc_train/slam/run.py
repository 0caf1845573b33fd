"""`cohdc slam`: an RGB-D sequence in, a trajectory and its scores out."""

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cohdc_train import __version__
from cohdc_train.errors import DataError
from cohdc_train.slam.config import MAX_KEYPOINTS, Culling, Method
from cohdc_train.slam.dynamics.mask_sources import MaskFolder, SegmenterMasks, no_masks
from cohdc_train.slam.frame import PoseCallback
from cohdc_train.slam.geometry.calibration import choose_camera
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.growing_sequence import Followed
from cohdc_train.slam.io.live import stopped_by_ctrl_c
from cohdc_train.slam.io.results import check_out, measure, publish_run, write_run
from cohdc_train.slam.io.sources import Recorded, Source, rgbd_layout
from cohdc_train.slam.io.stereo import stereo_layout
from cohdc_train.slam.runner import RunObserver, play
from cohdc_train.slam.runtime.threads import one_thread
from cohdc_train.slam.runtime.workers import workers
from cohdc_train.slam.tracking.tracker import MIN_START, Tracker
from cohdc_train.slam.visualization.map_files import MapFiles
from cohdc_train.slam.visualization.rerun_viewer import Viewer
from cohdc_train.trajectory.trajectory import Trajectory


def slam(
    *,
    sequence: Path,
    out: Path,
    model: Path | None = None,
    masks: Path | None = None,
    camera: Path | None = None,
    seed: int = 0,
    features: int = MAX_KEYPOINTS,
    culling: Culling = Culling(),  # noqa: B008 - frozen, and jsonargparse reads the defaults from it
    method: Method = Method(),  # noqa: B008 - the same
    realtime: bool = False,
    cloud: bool = False,
    follow: bool = False,
    idle: float = 10.0,
    view: bool = False,
    rrd: Path | None = None,
) -> dict[str, Any]:
    """Track an RGB-D camera or a stereo pair through a TUM-format sequence, people removed by masks
    or a model.

    Writes trajectory.txt (TUM format, every tracked frame), metrics.json, frames.csv, config.yaml,
    map.ply, map.png and pictures/ into the output folder, and returns the metrics. Raises
    DataError, naming file and line, for input that cannot be used.

    Args:
        sequence: folder with rgb.txt, depth.txt and their images, or left.txt and right.txt of a
            rectified stereo pair whose camera yaml has a baseline; groundtruth.txt is used for
            scores when there.
        out: folder for the results. Files of a former run are replaced and all others stay. A
            folder that holds other files with the names of results is refused.
        model: ONNX written by `cohdc export`, or a shipped network's name (person, person_s); every
            frame is segmented.
        masks: folder of PNGs with the names of the colour images, above 0 = dynamic.
        camera: camera yaml; else camera.yaml of the sequence, else a guess from the folder's name.
        seed: of the random samples; the same seed gives the same numbers.
        features: corners per frame.
        culling: how masks are made.
        method: which parts of the method run.
        realtime: frames come at the pace of their stamps, one that is late is dropped and counted;
            masks and mapping are made beside tracking. Then the numbers depend on the machine.
        cloud: write cloud.ply too, the dense coloured points of all that stands still.
        follow: the sequence is still being written: take frames as its lists grow.
        idle: s without a new frame after which a followed sequence has ended; a file named done
            there ends it, too.
        view: show the run in rerun's window while it goes; needs `pip install 'cohdc-train[view]'`.
        rrd: file to record the same for rerun, to be looked at later.
    """
    _check_options(out, cloud, model, masks, seed, features)
    source, origin = _source(sequence, camera, follow, idle)
    return run_source(
        source,
        out=out,
        model=model,
        masks=masks,
        seed=seed,
        features=features,
        culling=culling,
        method=method,
        realtime=realtime,
        cloud=cloud,
        view=view,
        rrd=rrd,
        origin=origin,
    )


def run_source(
    source: Source,
    *,
    out: Path,
    model: Path | None = None,
    masks: Path | None = None,
    seed: int = 0,
    features: int = MAX_KEYPOINTS,
    culling: Culling | None = None,
    method: Method | None = None,
    realtime: bool = False,
    cloud: bool = False,
    view: bool = False,
    rrd: Path | None = None,
    observers: Sequence[RunObserver] = (),
    on_pose: PoseCallback | None = None,
    origin: dict[str, str] | None = None,
) -> dict[str, Any]:
    """`slam` of any source of views, a camera of one's own for instance; the same files, metrics
    and errors. One run at a time in a process (`one_thread`).

    on_pose: called with every frame's pose as soon as it is known; watchers: when what the frame
    adds to the map has been done as well, in real time up to a frame's time later; origin: words
    about the source for config.yaml. Raises DataError when no frame comes.
    """
    _check_options(out, cloud, model, masks, seed, features)
    culling, method = culling or Culling(), method or Method()
    truth = None if source.groundtruth is None else Trajectory.load_tum(source.groundtruth)
    maker = _masks(model, masks, source.camera, culling, 1 if realtime else 0)
    options = {
        "model": model,
        "masks": masks,
        "seed": seed,
        "features": features,
        "realtime": realtime,
    }
    config: dict[str, Any] = {
        key: str(v) if isinstance(v, Path) else v for key, v in options.items()
    }
    config |= {
        "culling": asdict(culling),
        "method": asdict(method),
        "camera": source.camera.as_dict(),
    }
    config |= {**(origin or {}), "version": __version__}
    with (
        one_thread(),
        tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder,
    ):
        part = Path(folder)
        with ExitStack() as stack:
            beside = stack.enter_context(workers(source, maker)) if realtime else None
            in_time = (beside.executor, beside.source.spent) if beside else ()
            tracker = Tracker(source.camera, features, seed, method, *in_time)
            files = stack.enter_context(MapFiles(source.camera, part, cloud))
            observers = [files, *observers]
            if view or rrd is not None:
                observers.append(stack.enter_context(Viewer(source.camera, view, rrd)))
            stack.enter_context(stopped_by_ctrl_c(source))
            views, mask_of = (
                (beside.source, beside.mask_of) if beside else (source, maker or no_masks)
            )
            answer = beside.answering(on_pose) if beside else on_pose
            records = play(tracker, views, mask_of, part / "pictures", observers, answer)
            files.write(tracker)
        trajectory = Trajectory(*tracker.trajectory())
        metrics = {
            "seed": seed,
            "realtime": realtime,
            "loops": tracker.loops,
            "without_depth": source.without_depth,
        }
        metrics["keyframes_in_map"] = len(tracker.map.keyframes)
        metrics |= measure(records, trajectory, truth, beside.source.dropped if beside else 0)
        metrics |= beside.metrics() if beside else {}
        write_run(part, records, trajectory, metrics, config)
        publish_run(part, out)
    print(f"{summary(metrics)}\nwritten to {out}")
    return metrics


def summary(metrics: dict[str, Any]) -> str:
    """The small table at the end of a run."""
    rows = [
        (
            "frames",
            f"{metrics['tracked']} of {metrics['frames']} tracked ({100 * metrics['coverage']:.1f} %)",
        ),
        (
            "keyframes",
            f"{metrics['keyframes']}, {metrics['keyframes_in_map']} of them in the map at the end",
        ),
        ("loops closed", str(metrics["loops"])),
        ("frames/s", f"{metrics['fps']:.1f}"),
    ]
    times = {f"{stage} ms": quantiles for stage, quantiles in metrics["ms"].items()}
    if metrics["realtime"]:
        rows.append(("dropped", str(metrics["dropped"])))
        names = {
            "segmenter_ms": "segmenter ms",
            "mask_age_ms": "mask age ms",
            "latency_ms": "latency ms",
        }
        times |= {text: metrics[key] for key, text in names.items() if key in metrics}
    rows += [(name, f"p50 {q['p50']:.1f}  p95 {q['p95']:.1f}") for name, q in times.items()]
    for key in ("ate_m", "rpe_1s_m", "rpe_1s_deg", "rpe_all_pairs_m"):
        if key in metrics:
            rows.append(
                (key, "  ".join(f"{name} {value:.4f}" for name, value in metrics[key].items()))
            )
    return "\n".join(f"  {name:<16}{text}" for name, text in rows)


def _check_options(
    out: Path,
    cloud: bool,
    model: Path | None,
    masks: Path | None,
    seed: int,
    features: int,
) -> None:
    if model is not None and masks is not None:
        raise DataError("give --model or --masks, not both")
    if seed < 0:
        raise DataError(f"seed is {seed}; it cannot be below 0")
    if features < MIN_START:
        raise DataError(f"features is {features}; a map cannot start with fewer than {MIN_START}")
    check_out(out, cloud)


def _source(
    sequence: Path, camera: Path | None, follow: bool, idle: float
) -> tuple[Source, dict[str, str]]:
    """The frames of a folder, and what config.yaml says of where they come from."""
    if not sequence.is_dir():
        raise DataError(f"{sequence}: no such folder")
    intrinsics, origin = choose_camera(sequence, camera)
    print(f"camera: {origin}")
    words = {"sequence": str(sequence), "camera_origin": origin}
    stereo = (sequence / "left.txt").is_file() or (
        intrinsics.baseline > 0 and not (sequence / "rgb.txt").is_file()
    )
    layout = stereo_layout(intrinsics) if stereo else rgbd_layout(intrinsics)
    if follow:
        print(
            f"sequence: {layout.first} and {layout.second} as they grow; a file {sequence / 'done'} or Ctrl-C ends it"
        )
        return Followed(sequence, intrinsics, layout, idle), words
    source = Recorded(sequence, intrinsics, layout)
    print(
        f"sequence: {len(source)} pairs; {source.without_depth} images have no partner and are left out"
    )
    return source, words


def _masks(
    model: Path | None, masks: Path | None, camera: Camera, culling: Culling, threads: int
) -> MaskFolder | SegmenterMasks | None:
    """threads: of the segmenter, 0 = as many as there are cores."""
    if masks is not None:
        return MaskFolder(masks, camera, culling)
    if model is None:
        return None
    from cohdc_train.segmenter import Segmenter

    return SegmenterMasks(Segmenter(model, threads), culling)
