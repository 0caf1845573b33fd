"""`cohdc slam`: an RGB-D sequence in, a trajectory and its scores out."""

import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train import __version__
from cohdc_train.errors import DataError
from cohdc_train.slam.camera import Camera, choose_camera
from cohdc_train.slam.culling import Culling, FolderMasks, MaskSource, ModelMasks, no_masks
from cohdc_train.slam.features import FeatureExtractor, Features
from cohdc_train.slam.method import Method
from cohdc_train.slam.realtime import workers
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
from cohdc_train.slam.source import Recorded, Source, View
from cohdc_train.slam.tracking import Tracker
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
    realtime: bool = False,
) -> dict[str, Any]:
    """Track an RGB-D camera through a TUM-format sequence; people are removed when masks or a model are given.

    Writes trajectory.txt (TUM format, every tracked frame), metrics.json, frames.csv, config.yaml and pictures/ into
    the output folder, and returns the metrics. Raises DataError, naming file and line, for input that cannot be used.

    Args:
        sequence: folder with rgb.txt, depth.txt and their images; groundtruth.txt is used for scores when there.
        out: folder for the results; files of a former run are replaced.
        model: ONNX written by `cohdc export`, or a shipped network's name: person; every frame is segmented.
        masks: folder of PNGs with the names of the colour images, above 0 = dynamic.
        camera: camera yaml; else camera.yaml of the sequence, else a guess from the folder's name.
        seed: of the random samples; the same seed gives the same numbers.
        features: corners per frame.
        culling: how masks are made.
        method: which parts of the method run.
        realtime: frames come at the pace of their stamps, one that is late is dropped and counted; masks and mapping
            are made beside tracking. Then the numbers depend on the machine.
    """
    if model is not None and masks is not None:
        raise DataError("give --model or --masks, not both")
    if not sequence.is_dir():
        raise DataError(f"{sequence}: no such folder")
    check_out(out)
    intrinsics, origin = choose_camera(sequence, camera)
    source = Recorded(sequence, intrinsics)
    maker = _masks(model, masks, intrinsics, culling, 1 if realtime else 0)
    print(f"camera: {origin}")
    print(f"sequence: {len(source)} pairs; {source.without_depth} colour images have no depth image and are left out")
    options = {"model": model, "masks": masks, "sequence": sequence, "seed": seed, "features": features}
    config: dict[str, Any] = {key: str(v) if isinstance(v, Path) else v for key, v in options.items()}
    config |= {"culling": asdict(culling), "method": asdict(method), "realtime": realtime}
    config |= {"camera": intrinsics.as_dict(), "camera_origin": origin, "version": __version__}
    with _one_thread(), tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder, ExitStack() as s:
        part = Path(folder)
        beside = s.enter_context(workers(source, maker)) if realtime else None
        tracker = Tracker(intrinsics, features, seed, method, beside.executor if beside else None)
        views, mask_of = (beside.source, beside.mask_of) if beside else (source, maker or no_masks)
        records = _run(tracker, views, mask_of, part)
        trajectory = Trajectory(*tracker.trajectory())
        metrics = {"seed": seed, "realtime": realtime, "loops": tracker.loops}
        metrics["without_depth"] = source.without_depth
        metrics |= measure(records, trajectory, source.groundtruth, beside.source.dropped if beside else 0)
        metrics |= beside.metrics() if beside else {}
        write_run(part, records, trajectory, metrics, config)
        publish(part, out)
    print(f"{summary(metrics)}\nwritten to {out}")
    return metrics


def summary(metrics: dict[str, Any]) -> str:
    """The small table at the end of a run."""
    rows = [
        ("frames", f"{metrics['tracked']} of {metrics['frames']} tracked ({100 * metrics['coverage']:.1f} %)"),
        ("keyframes", str(metrics["keyframes"])),
        ("loops closed", str(metrics["loops"])),
        ("frames/s", f"{metrics['fps']:.1f}"),
    ]
    times = {f"{stage} ms": quantiles for stage, quantiles in metrics["ms"].items()}
    if metrics["realtime"]:
        rows.append(("dropped", str(metrics["dropped"])))
        names = {"segmenter_ms": "segmenter ms", "mask_age_ms": "mask age ms", "latency_ms": "latency ms"}
        times |= {text: metrics[key] for key, text in names.items() if key in metrics}
    rows += [(name, f"p50 {q['p50']:.1f}  p95 {q['p95']:.1f}") for name, q in times.items()]
    for key in ("ate_m", "rpe_1s_m", "rpe_1s_deg", "rpe_all_pairs_m"):
        if key in metrics:
            rows.append((key, "  ".join(f"{name} {value:.4f}" for name, value in metrics[key].items())))
    return "\n".join(f"  {name:<16}{text}" for name, text in rows)


def _masks(
    model: Path | None, masks: Path | None, camera: Camera, culling: Culling, threads: int
) -> FolderMasks | ModelMasks | None:
    if masks is not None:
        return FolderMasks(masks, camera, culling)
    if model is None:
        return None
    from cohdc_train.segmenter import Segmenter

    return ModelMasks(Segmenter(model, threads), culling)


@dataclass(frozen=True)
class _Picture:
    """What is drawn of a frame when the run is over, so that no time of the run goes into it."""

    view: View
    mask: NDArray[np.bool_] | None
    features: Features


def _run(tracker: Tracker, source: Source, mask_of: MaskSource, part: Path) -> list[FrameRecord]:
    count = len(source)
    pictured = set(np.linspace(0, count - 1, min(_PICTURES, count)).round().astype(int).tolist())
    records: list[FrameRecord] = []
    pictures = []
    for index, view in enumerate(source):
        record, mask = _step(tracker, view, mask_of)
        records.append(record)
        if index in pictured and tracker.features is not None:
            pictures.append(_Picture(view, mask, tracker.features))
        _progress(index + 1, count, record)
    tracker.finish()
    (part / "pictures").mkdir()
    for picture in pictures:
        _draw(picture, FeatureExtractor(tracker.camera, tracker.budget), part / "pictures")
    return records


def _step(tracker: Tracker, view: View, mask_of: MaskSource) -> tuple[FrameRecord, NDArray[np.bool_] | None]:
    start = time.perf_counter()
    mask = mask_of(view)
    segment_ms = 0.0 if mask is None else 1e3 * (time.perf_counter() - start)
    pose = tracker.track(view.rgb, view.depth, view.t, mask, view.depth_t)
    mask = tracker.mask
    return FrameRecord(view.stamp, pose, 0.0 if mask is None else float(mask.mean()), segment_ms), mask


def _draw(picture: _Picture, extract: FeatureExtractor, folder: Path) -> None:
    view, mask = picture.view, picture.mask
    before = draw_before(view.rgb, extract(view.rgb, view.depth), mask)
    write_jpeg(folder / f"{view.stamp}_before.jpg", before)
    if mask is not None:
        write_jpeg(folder / f"{view.stamp}_after.jpg", draw_after(view.rgb, picture.features, mask))


def _progress(done: int, count: int, record: FrameRecord) -> None:
    """One line that renews itself on a terminal; elsewhere a line per tenth."""
    state = f"{record.pose.inliers} inliers" if record.pose.tracked else "lost"
    line = f"frame {done}/{count}  {state}"
    if sys.stderr.isatty():
        print(f"\r{line:<50}", end="\n" if done == count else "", file=sys.stderr, flush=True)
    elif done * 10 // count > (done - 1) * 10 // count:
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
