"""`cohdc slam`: an RGB-D sequence in, a trajectory and its scores out."""

import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train import __version__
from cohdc_train.errors import DataError
from cohdc_train.slam.camera import Camera, choose_camera
from cohdc_train.slam.culling import Culling, FolderMasks, MaskSource, ModelMasks, no_masks
from cohdc_train.slam.features import FeatureExtractor
from cohdc_train.slam.live import Followed, LiveSource, stopped_by_ctrl_c
from cohdc_train.slam.map_files import MapFiles
from cohdc_train.slam.method import Method
from cohdc_train.slam.results import (
    FrameRecord,
    check_out,
    draw_after,
    draw_before,
    measure,
    publish,
    write_jpeg,
    write_run,
)
from cohdc_train.slam.source import Recorded, Source, View, rgbd_layout
from cohdc_train.slam.stereo import stereo_layout
from cohdc_train.slam.tracking import Tracker
from cohdc_train.slam.viewer import Viewer
from cohdc_train.slam.watching import Watcher
from cohdc_train.trajectory import Trajectory

_PICTURES = 6


def slam(
    *,
    sequence: Path,
    out: Path,
    model: Path | None = None,
    masks: Path | None = None,
    camera: Path | None = None,
    seed: int = 0,
    features: int = 1000,
    culling: Culling = Culling(),  # noqa: B008 - frozen, and jsonargparse reads the defaults from it
    method: Method = Method(),  # noqa: B008 - the same
    cloud: bool = False,
    follow: bool = False,
    idle: float = 10.0,
    view: bool = False,
    rrd: Path | None = None,
) -> dict[str, Any]:
    """Track an RGB-D camera or a stereo pair through a TUM-format sequence, people removed by masks or a model.

    Writes trajectory.txt (TUM format, every tracked frame), metrics.json, frames.csv, config.yaml, map.ply, map.png and
    pictures/ into the output folder, and returns the metrics. Raises DataError, naming file and line, for input that
    cannot be used.

    Args:
        sequence: folder with rgb.txt, depth.txt and their images, or left.txt and right.txt of a rectified stereo pair
            whose camera yaml has a baseline; groundtruth.txt is used for scores when there.
        out: folder for the results; files of a former run are replaced.
        model: ONNX written by `cohdc export`, or a shipped network's name: person; every frame is segmented.
        masks: folder of PNGs with the names of the colour images, above 0 = dynamic.
        camera: camera yaml; else camera.yaml of the sequence, else a guess from the folder's name.
        seed: of the random samples; the same seed gives the same numbers.
        features: corners per frame.
        culling: how masks are made.
        method: which parts of the method run.
        cloud: write cloud.ply too, the dense coloured points of all that stands still.
        follow: the sequence is still being written: take frames as its lists grow.
        idle: s without a new frame after which a followed sequence has ended; a file named done there ends it, too.
        view: show the run in rerun's window while it goes; needs `pip install 'cohdc-train[view]'`.
        rrd: file to record the same for rerun, to be looked at later.
    """
    _check_options(out, model, masks)
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
    features: int = 1000,
    culling: Culling | None = None,
    method: Method | None = None,
    cloud: bool = False,
    view: bool = False,
    rrd: Path | None = None,
    watchers: Sequence[Watcher] = (),
    origin: dict[str, str] | None = None,
) -> dict[str, Any]:
    """`slam` of any source of views, a camera of one's own for instance; the same files, metrics and errors.

    watchers: called after every frame; origin: words about the source for config.yaml. Raises DataError when no frame
    comes.
    """
    _check_options(out, model, masks)
    culling, method = culling or Culling(), method or Method()
    mask_of = _mask_source(model, masks, source.camera, culling)
    options = {"model": model, "masks": masks, "seed": seed, "features": features}
    config: dict[str, Any] = {key: str(v) if isinstance(v, Path) else v for key, v in options.items()}
    config |= {"culling": asdict(culling), "method": asdict(method), "camera": source.camera.as_dict()}
    config |= {**(origin or {}), "version": __version__}
    with _one_thread(), tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder:
        part = Path(folder)
        tracker = Tracker(source.camera, features, seed, method)
        with ExitStack() as stack:
            files = stack.enter_context(MapFiles(source.camera, part, cloud))
            watchers = [files, *watchers]
            if view or rrd is not None:
                watchers.append(stack.enter_context(Viewer(source.camera, view, rrd)))
            stack.enter_context(stopped_by_ctrl_c(source))
            records = _run(tracker, source, mask_of, part, watchers)
            files.write(tracker)
        trajectory = Trajectory(*tracker.trajectory())
        metrics = {"seed": seed, "without_depth": source.without_depth, "loops": tracker.loops}
        metrics |= measure(records, trajectory, source.groundtruth)
        write_run(part, records, trajectory, metrics, config)
        publish(part, out)
    print(summary(metrics))
    print(f"written to {out}")
    return metrics


def summary(metrics: dict[str, Any]) -> str:
    """The small table at the end of a run."""
    rows = [
        ("frames", f"{metrics['tracked']} of {metrics['frames']} tracked ({100 * metrics['coverage']:.1f} %)"),
        ("keyframes", str(metrics["keyframes"])),
        ("loops closed", str(metrics["loops"])),
        ("frames/s", f"{metrics['fps']:.1f}"),
    ]
    rows += [(f"{stage} ms", f"p50 {q['p50']:.1f}  p95 {q['p95']:.1f}") for stage, q in metrics["ms"].items()]
    for key in ("ate_m", "rpe_1s_m", "rpe_1s_deg", "rpe_all_pairs_m"):
        if key in metrics:
            rows.append((key, "  ".join(f"{name} {value:.4f}" for name, value in metrics[key].items())))
    return "\n".join(f"  {name:<16}{text}" for name, text in rows)


def _check_options(out: Path, model: Path | None, masks: Path | None) -> None:
    if model is not None and masks is not None:
        raise DataError("give --model or --masks, not both")
    check_out(out)


def _source(sequence: Path, camera: Path | None, follow: bool, idle: float) -> tuple[Source, dict[str, str]]:
    """The frames of a folder, and what config.yaml says of where they come from."""
    if not sequence.is_dir():
        raise DataError(f"{sequence}: no such folder")
    intrinsics, origin = choose_camera(sequence, camera)
    print(f"camera: {origin}")
    words = {"sequence": str(sequence), "camera_origin": origin}
    stereo = (sequence / "left.txt").is_file() or (intrinsics.baseline > 0 and not (sequence / "rgb.txt").is_file())
    layout = stereo_layout(intrinsics) if stereo else rgbd_layout(intrinsics)
    if follow:
        print(
            f"sequence: {layout.first} and {layout.second} as they grow; a file {sequence / 'done'} or Ctrl-C ends it"
        )
        return Followed(sequence, intrinsics, layout, idle), words
    source = Recorded(sequence, intrinsics, layout)
    print(f"sequence: {len(source)} pairs; {source.without_depth} images have no partner and are left out")
    return source, words


def _mask_source(model: Path | None, masks: Path | None, camera: Camera, culling: Culling) -> MaskSource:
    if masks is not None:
        return FolderMasks(masks, camera, culling)
    if model is None:
        return no_masks
    from cohdc_train.segmenter import Segmenter

    return ModelMasks(Segmenter(model), culling)


def _run(
    tracker: Tracker, source: Source, mask_of: MaskSource, part: Path, watchers: Sequence[Watcher]
) -> list[FrameRecord]:
    (part / "pictures").mkdir()
    count = len(source)
    pictured = _pictured(count)
    records: list[FrameRecord] = []
    try:
        for index, view in enumerate(source):
            mask, record = _step(tracker, view, mask_of, part / "pictures" if index in pictured else None)
            records.append(record)
            for watcher in watchers:
                watcher(view, mask, record, tracker)
            _progress(index + 1, count, record)
    except DataError as error:
        if not records or not isinstance(source, LiveSource):
            raise
        print(f"ended: {error}", file=sys.stderr)  # what a live run has so far is not lost
    if not records:
        raise DataError("no frame came: nothing is written")
    return records


def _pictured(count: int) -> set[int]:
    """Which frames are drawn; where nobody knows how many come, the first and then ever rarer ones."""
    if count == 0:
        return {0, *(30 << k for k in range(20))}
    return set(np.linspace(0, count - 1, min(_PICTURES, count)).round().astype(int).tolist())


def _step(
    tracker: Tracker, view: View, mask_of: MaskSource, pictures: Path | None
) -> tuple[NDArray[np.bool_] | None, FrameRecord]:
    """One frame: its mask and what became of it; when it is to be pictured, the drawing stays outside the times."""
    start = time.perf_counter()
    mask = mask_of(view)
    segment_ms = 0.0 if mask is None else 1e3 * (time.perf_counter() - start)
    pose = tracker.track(view.rgb, view.depth, view.t, mask, view.depth_t)
    mask = tracker.mask
    if pictures is not None and tracker.features is not None:
        unmasked = FeatureExtractor(tracker.camera, tracker.budget)(view.rgb, view.depth)
        write_jpeg(pictures / f"{view.stamp}_before.jpg", draw_before(view.rgb, unmasked, mask))
        if mask is not None:
            write_jpeg(pictures / f"{view.stamp}_after.jpg", draw_after(view.rgb, tracker.features, mask))
    culled = 0.0 if mask is None else float(mask.mean())
    return mask, FrameRecord(view.stamp, pose, culled, segment_ms, view.depth_ms)


def _progress(done: int, count: int, record: FrameRecord) -> None:
    """One line that renews itself on a terminal; elsewhere a line per tenth, or per hundred where no end is known."""
    state = f"{record.pose.inliers} inliers" if record.pose.tracked else "lost"
    line = f"frame {done}/{count}  {state}" if count else f"frame {done}  {state}"
    if sys.stderr.isatty():
        print(f"\r{line:<50}", end="\n" if done == count else "", file=sys.stderr, flush=True)
    elif done % 100 == 0 if count == 0 else done * 10 // count > (done - 1) * 10 // count:
        print(line, file=sys.stderr, flush=True)


@contextmanager
def _one_thread() -> Iterator[None]:
    """OpenCV on one thread with a fixed seed: the order of its sums cannot change from run to run."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
