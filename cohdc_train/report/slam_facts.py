"""Facts, tables and sentences of SLAM runs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cohdc_train.report.names import ERRORS, REALTIME, STAGES, STATISTICS, count, seconds
from cohdc_train.report.page import Fact, Table
from cohdc_train.report.slam_run import SlamRun
from cohdc_train.report.tables import mark_best

_COMPARED = ("ate_m", "rpe_1s_m", "rpe_1s_deg")
_SPANS = 8  # lost spans that are named one by one


def lead(run: SlamRun) -> str:
    """Return the run in one sentence."""
    frames, tracked = _frames(run)
    error = run.metrics.get("ate_m")
    if "frames" not in run.metrics:
        share = f"{count(tracked, 'pose')}"
    elif tracked == 0:
        return f"Nothing was tracked: all {count(frames, 'frame')} were lost."
    else:
        share = f"{tracked} of {count(frames, 'frame')} tracked"
    way = f" over {run.length():.1f} m" if run.trajectory is not None else ""
    if error is None:
        return f"{share}{way}. Without ground truth there are no errors."
    return f"{share}{way}, with a translation error of {error['rmse']:.4f} m."


def facts(run: SlamRun) -> list[Fact]:
    """Return what to know of a run first."""
    metrics = run.metrics
    frames, tracked = _frames(run)
    share = f"{100 * metrics['coverage']:.1f} %"
    found = [
        Fact("Frames tracked", f"{tracked} of {frames}", share),
        _lost_fact(run, frames - tracked),
    ]
    if "frames" not in metrics:  # of `cohdc evaluate`, which knows poses alone
        found = [Fact("Ground truth covered", share), Fact("Poses matched", str(metrics["pairs"]))]
    if "dropped" in metrics:
        found.append(
            Fact("Frames dropped", str(metrics["dropped"]), "came while tracking was busy")
        )
    if "ate_m" in metrics:
        largest = f"largest {metrics['ate_m']['max']:.4f} m"
        error = f"{metrics['ate_m']['rmse']:.4f} m"
        found.append(Fact("Translation error (ATE RMSE)", error, largest))
    if run.trajectory is not None:
        found.append(Fact("Trajectory length", f"{run.length():.2f} m", _duration(run)))
    if "keyframes" in metrics:
        left = metrics.get("keyframes_in_map")
        detail = "" if left is None else f"{left} in the map at the end"
        found.append(Fact("Keyframes", str(metrics["keyframes"]), detail))
    if "loops" in metrics:
        found.append(Fact("Loops closed", str(metrics["loops"])))
    if "fps" in metrics:
        pace = "at the camera's pace" if metrics.get("realtime") else "as fast as it goes"
        found.append(Fact("Speed", f"{metrics['fps']:.1f} frames/s", pace))
    return found + _settings(run)


def common_settings(runs: Sequence[SlamRun]) -> list[Fact]:
    """Return the facts known before a run in which all runs agree."""
    first, *others = [_settings(run) for run in runs]
    return [fact for fact in first if all(fact in of_run for of_run in others)]


def _settings(run: SlamRun) -> list[Fact]:
    """Return the facts that were known before the run: camera, model, seed, version."""
    config = run.config
    found = []
    camera = config.get("camera")
    if isinstance(camera, dict):
        size = f"{camera.get('width', '?')} × {camera.get('height', '?')} px"
        lens = f"fx {camera['fx']:g}, fy {camera['fy']:g}" if {"fx", "fy"} <= set(camera) else ""
        found.append(Fact("Camera", size, lens))
    if "model" in config or "masks" in config:
        found.append(Fact("Masks", *_masks(config)))
    if "seed" in config:
        found.append(Fact("Seed", str(config["seed"])))
    if "sequence" in config:
        found.append(Fact("Sequence", Path(str(config["sequence"])).name))
    if "version" in config:
        found.append(Fact("Version", f"cohdc {config['version']}"))
    return found


def _masks(config: Mapping[str, Any]) -> tuple[str, str]:
    """Return where the masks came from: a name and what it is."""
    if config.get("model"):
        return Path(str(config["model"])).name, "segmentation model"
    if config.get("masks"):
        return Path(str(config["masks"])).name, "folder of masks"
    return "none", "static scene assumed"


def _lost_fact(run: SlamRun, lost: int) -> Fact:
    if run.frames is None or lost == 0:
        return Fact("Frames lost", str(lost), bad=lost > 0)
    spans = len(run.frames.lost_spans())
    return Fact("Frames lost", str(lost), f"in {count(spans, 'place')}" if spans else "", bad=True)


def _duration(run: SlamRun) -> str:
    timestamps = run.frames.timestamps if run.frames is not None else None
    if timestamps is None and run.trajectory is not None:
        timestamps = run.trajectory.timestamps
    return (
        ""
        if timestamps is None or len(timestamps) < 2
        else f"in {seconds(timestamps[-1] - timestamps[0])}"
    )


def _frames(run: SlamRun) -> tuple[int, int]:
    """Return how many frames there were and how many were tracked."""
    frames = int(run.metrics.get("frames", 0 if run.trajectory is None else len(run.trajectory)))
    return frames, int(run.metrics.get("tracked", round(frames * run.metrics["coverage"])))


def where_it_went_wrong(run: SlamRun) -> list[str]:
    """Return sentences on where a run was lost and where it had the fewest inliers."""
    if run.frames is None or not len(run.frames):
        return []
    times = run.frames.timestamps - run.start
    spans = run.frames.lost_spans()
    words = [
        f"{times[first]:.1f} s ({count(last - first + 1, 'frame')})"
        for first, last in spans[:_SPANS]
    ]
    more = f" and in {len(spans) - _SPANS} more places" if len(spans) > _SPANS else ""
    lost = [f"Tracking was lost at {', '.join(words)}{more}."] if words else ["No frame was lost."]
    inliers = run.frames.columns["inliers"]
    tracked = ~run.frames.lost
    if not tracked.any():
        return lost
    fewest = int(inliers[tracked].min())
    at = float(times[tracked][inliers[tracked].argmin()])
    return [*lost, f"The fewest inliers of a tracked frame were {fewest}, at {at:.1f} s."]


def error_table(runs: Sequence[SlamRun]) -> list[Table]:
    """Return the six statistics of every error, a row per run and error."""
    rows = []
    for key, quantity in ERRORS.items():
        title = quantity.title
        for run in runs:
            if key in run.metrics:
                values = [quantity.text(run.metrics[key][name]) for name in STATISTICS]
                rows.append([title, run.label, *values])
                title = ""  # once for all runs
    if not rows:
        return []
    head = ["Error", "Run", *STATISTICS.values()]
    if len(runs) == 1:
        head, rows = [head[0], *head[2:]], [[row[0], *row[2:]] for row in rows]
    note = "After rigid alignment to the ground truth, without scale. RMSE: root mean square."
    return [Table("", head, rows, words=min(2, len(runs)), note=note)]


def time_table(runs: Sequence[SlamRun]) -> list[Table]:
    """Return median and 95th percentile of every stage, a row per run and stage."""
    rows = []
    for run in runs:
        named = {STAGES.get(key, key): time for key, time in run.metrics.get("ms", {}).items()}
        named |= {text: run.metrics[key] for key, text in REALTIME.items() if key in run.metrics}
        for name, time in named.items():
            rows.append([name, run.label, f"{time['p50']:.1f}", f"{time['p95']:.1f}"])
    if not rows:
        return []
    head = ["Stage", "Run", "Median, ms", "95th percentile, ms"]
    if len(runs) == 1:
        head, rows = [head[0], *head[2:]], [[row[0], *row[2:]] for row in rows]
    return [Table("", head, rows, words=min(2, len(runs)))]


def comparison(runs: Sequence[SlamRun]) -> Table:
    """Return a row per run with what runs are compared by; the best of a column is marked."""
    columns: list[tuple[str, int, list[float | None], int]] = [
        ("Frames tracked, %", 1, [100 * run.metrics["coverage"] for run in runs], 1),
        ("Frames lost", -1, [float(_frames(run)[0] - _frames(run)[1]) for run in runs], 0),
    ]
    for key in _COMPARED:
        values = [run.metrics[key]["rmse"] if key in run.metrics else None for run in runs]
        name = f"{ERRORS[key].name}, RMSE, {ERRORS[key].unit}"
        columns.append((name, -1, values, ERRORS[key].digits))
    columns += [
        ("Speed, frames/s", 1, [run.metrics.get("fps") for run in runs], 1),
        ("Length, m", 0, [run.length() for run in runs], 2),
        ("Keyframes", 0, [run.metrics.get("keyframes") for run in runs], 0),
        ("Loops", 0, [run.metrics.get("loops") for run in runs], 0),
        ("Dropped", -1, [run.metrics.get("dropped") for run in runs], 0),
    ]
    columns = [column for column in columns if any(value is not None for value in column[2])]
    rows = [
        [run.label, *("–" if v[i] is None else f"{v[i]:.{digits}f}" for _, _, v, digits in columns)]
        for i, run in enumerate(runs)
    ]
    head = ["Run", *(name for name, *_ in columns)]
    masks = [_masks(run.config)[0] if run.config else "" for run in runs]
    if any(masks):
        head.insert(1, "Masks")
        rows = [[row[0], name, *row[1:]] for row, name in zip(rows, masks, strict=True)]
    words = len(head) - len(columns)
    best = mark_best(rows, [0] * words + [better for _, better, _, _ in columns])
    note = "Bold: the best of a column." if best else ""
    return Table("", head, rows, words, best, note)
