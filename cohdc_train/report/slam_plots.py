"""SLAM runs drawn: paths with equal axes, errors on one scale, and a strip with every frame."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cohdc_train.report.slam_run import Floats, Frames, SlamRun
from cohdc_train.report.svg import INK, LOST, SERIES, TRUTH, Draw, color, dash, legend, log_scale
from cohdc_train.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

View = tuple[str, int, int, float]  # title, axis to the right, axis upwards and its sign

# Against ground truth z is up; without it the world is the first camera: y down, z forward.
TRUTH_VIEWS: Sequence[View] = (
    ("From above", 0, 1, 1),
    ("From the front", 0, 2, 1),
    ("From the side", 1, 2, 1),
)
CAMERA_VIEWS: Sequence[View] = (
    ("From above", 0, 2, 1),
    ("From behind", 0, 1, -1),
    ("From the side", 2, 1, -1),
)
_DrawRow = Callable[["Axes", Frames, Floats, int], None]
_BINS_PER_INCH = 48.0  # columns of a strip of one run: more are not seen
_LINE_POINTS = 5000  # of all lines of a figure together
_FEWEST_POINTS = 250  # of a line
_FOUR_NAMES = 6.0  # inches of a figure that has room for a legend's four names in a line
_SEGMENTS = 250  # pieces of a path with a color of their own
_LOG_FROM = 8.0  # ratio of two runs' errors from which the axis is logarithmic
_SHADES = (0.08, 0.9)  # part of the color map that is seen on white and on black


class StripScale(NamedTuple):
    """Scale that strips of several runs share, so that they can be compared.

    tops: row -> upper end of its axis; bins_per_inch: columns of a strip.
    """

    tops: Mapping[str, float]
    bins_per_inch: float


def draw_paths(view: View, truth: Trajectory | None, runs: Sequence[tuple[int, SlamRun]]) -> Draw:
    """Return a drawing of the positions of runs, m, seen along one axis, with equal axes.

    runs: with their places in the list, which give their colors.
    """

    def draw(figure: "Figure") -> None:
        axes = figure.subplots()
        _, i, j, sign = view
        if truth is not None:
            points = truth.positions
            axes.plot(
                points[:, i],
                sign * points[:, j],
                color=TRUTH,
                lw=2.4,
                alpha=0.35,
                label="ground truth",
            )
        for place, run in runs:
            points = run.path()[1]
            points = points[_thinned(points[:, 0], len(runs))]
            axes.plot(
                points[:, i], sign * points[:, j], dash(place), color=color(place), label=run.label
            )
        _equal(axes, view)
        legend(figure, axes)

    return draw


def draw_error_path(view: View, run: SlamRun, largest: float) -> Draw:
    """Return a drawing of one run's path, colored by its distance to the ground truth.

    largest: error at the end of the color scale, m, the same for every run of a page.
    """

    def draw(figure: "Figure") -> None:
        from matplotlib import colormaps
        from matplotlib.collections import LineCollection
        from matplotlib.colors import ListedColormap
        from matplotlib.ticker import MaxNLocator

        axes = figure.subplots()
        _, i, j, sign = view
        errors = run.errors()
        if errors is None or run.matched is None:
            return
        gaps = run.gaps(run.matched.timestamps)
        points = np.insert(run.matched.positions, gaps, np.nan, axis=0)[:, [i, j]] * (1, sign)
        pieces, values = _pieces(points, errors[1])
        shades = ListedColormap(colormaps["turbo"](np.linspace(*_SHADES, 256)))
        lines = LineCollection(pieces, cmap=shades, clim=(0, largest), linewidths=2.2)
        lines.set_array(values)
        lines.set_capstyle("round")
        axes.add_collection(lines)
        axes.autoscale_view()
        _equal(axes, view)
        bar = figure.colorbar(
            lines, ax=axes, location="bottom", shrink=0.8, aspect=40, pad=0.02, ticks=MaxNLocator(5)
        )
        bar.set_label("distance to the ground truth, m")
        bar.outline.set_visible(False)

    return draw


def draw_errors(runs: Sequence[tuple[int, SlamRun]]) -> Draw:
    """Return a drawing of the distance to the ground truth over time, all runs on one scale."""

    def draw(figure: "Figure") -> None:
        axes = figure.subplots()
        typical = []
        for place, run in runs:
            errors = run.errors()
            if errors is not None:
                timestamps, distances = errors
                typical.append(float(np.nanmedian(distances)))
                kept = _thinned(distances, len(runs))
                times = timestamps[kept] - run.start
                axes.plot(times, distances[kept], dash(place), color=color(place), label=run.label)
        if typical and max(typical) > _LOG_FROM * max(min(typical), 1e-6):
            log_scale(axes)
        else:
            axes.set_ylim(bottom=0)
        axes.set(xlabel="time, s", ylabel="distance to the ground truth, m")
        axes.margins(x=0.01)
        legend(figure, axes)

    return draw


def draw_strip(run: SlamRun, letters: dict[int, str], scale: StripScale) -> Draw:
    """Return a drawing of every frame: inliers, masked share, times; lost frames are red.

    letters: index of a frame -> the letter below which its image is shown; scale: of all runs.
    """
    frames = run.frames
    if frames is None:
        raise ValueError(f"{run.label}: has no frames to draw")
    times = frames.timestamps - run.start
    rows: dict[str, _DrawRow] = {"inliers": _draw_inliers}
    if frames.columns["culled_share"].any():
        rows["masked, %"] = _draw_masked
    rows["time, ms"] = _draw_times

    def draw(figure: "Figure") -> None:
        heights = [1.3, *[1.0] * (len(rows) - 1)]
        panels = np.ravel(figure.subplots(len(rows), 1, sharex=True, height_ratios=heights))
        bins = round(scale.bins_per_inch * figure.get_figwidth())
        for (name, draw_row), axes in zip(rows.items(), panels, strict=True):
            draw_row(axes, frames, times, bins)
            _mark_lost(axes, frames, times)
            axes.set(ylabel=name, ylim=(0, 1.05 * scale.tops[name]))
            axes.grid(axis="x", visible=False)
        _mark_frames(panels[0], times, letters, 1.05 * scale.tops["inliers"])
        panels[-1].set_xlabel("time, s")
        panels[-1].set_xlim(times[0], max(times[-1], times[0] + 1e-3))
        columns = 4 if figure.get_figwidth() > _FOUR_NAMES else 2
        panels[-1].legend(
            loc="lower left",
            bbox_to_anchor=(0, 0.98),
            ncols=columns,
            borderpad=0,
            columnspacing=1.2,
        )
        figure.align_ylabels(list(panels))

    return draw


def strip_scale(runs: Sequence[SlamRun]) -> StripScale:
    """Return the scale of strips that all runs fit in."""
    tops = {"inliers": 1.0, "masked, %": 1.0, "time, ms": 1.0}
    for run in runs:
        if run.frames is not None and len(run.frames):
            columns = run.frames.columns
            total = sum(columns[name] for name in ("segment_ms", "track_ms", "map_ms"))
            tops["inliers"] = max(tops["inliers"], float(columns["inliers"].max()))
            tops["masked, %"] = max(tops["masked, %"], float(100 * columns["culled_share"].max()))
            tops["time, ms"] = max(tops["time, ms"], float(np.quantile(total, 0.998)))
    return StripScale(tops, min(_BINS_PER_INCH, 4 * _BINS_PER_INCH / len(runs)))


def _draw_inliers(axes: "Axes", frames: Frames, times: Floats, bins: int) -> None:
    x, low = _binned(times, frames.columns["inliers"], np.minimum, bins)
    axes.fill_between(x, low, step="mid", color=SERIES[0], alpha=0.75, lw=0)
    keyframes = times[frames.columns["keyframe"] > 0]
    top = axes.get_xaxis_transform()
    axes.plot(
        keyframes, np.full(len(keyframes), 0.97), "|", color=INK, ms=5, mew=0.8, transform=top
    )


def _draw_masked(axes: "Axes", frames: Frames, times: Floats, bins: int) -> None:
    x, high = _binned(times, 100 * frames.columns["culled_share"], np.maximum, bins)
    axes.fill_between(x, high, step="mid", color=SERIES[3], alpha=0.75, lw=0)


def _draw_times(axes: "Axes", frames: Frames, times: Floats, bins: int) -> None:
    below: Floats | float = 0.0
    stages = {"segment_ms": "segmentation", "track_ms": "tracking", "map_ms": "mapping"}
    for place, (column, name) in zip((3, 0, 4), stages.items(), strict=True):
        if not frames.columns[column].any():
            continue
        x, high = _binned(times, frames.columns[column], np.maximum, bins)
        axes.fill_between(
            x, below, below + high, step="mid", color=SERIES[place], alpha=0.85, lw=0, label=name
        )
        below = below + high
    if len(times) > 2:
        interval = 1e3 * float(np.median(np.diff(times)))
        axes.axhline(
            interval, color=INK, lw=0.9, ls=(0, (4, 3)), label=f"camera, {interval:.0f} ms"
        )


def _mark_lost(axes: "Axes", frames: Frames, times: Floats) -> None:
    half = 0.5 * float(np.median(np.diff(times))) if len(times) > 1 else 0.01
    for first, last in frames.lost_spans():
        axes.axvspan(times[first] - half, times[last] + half, color=LOST, alpha=0.45, lw=0)


def _mark_frames(axes: "Axes", times: Floats, letters: dict[int, str], top: float) -> None:
    for index, letter in letters.items():
        axes.annotate(
            letter,
            (times[index], top),
            (0, 3),
            textcoords="offset points",
            ha="center",
            fontweight="bold",
            fontsize=9,
        )
        axes.axvline(times[index], color=INK, lw=0.7, alpha=0.7)


def _binned(times: Floats, values: Floats, combine: "np.ufunc", bins: int) -> tuple[Floats, Floats]:
    """Return times and values of a number of bins; a bin's value is its lowest or its highest."""
    if len(times) <= bins:
        return times, values
    starts = np.unique(np.linspace(0, len(times), bins, endpoint=False).astype(int))
    return times[starts], np.asarray(combine.reduceat(values, starts))


def _thinned(values: Floats, runs: int) -> NDArray[np.int64]:
    """Return indices of a line's points that are drawn: of every few the highest, and all gaps.

    values: [n], nan at gaps; runs: lines of the figure, which share `_LINE_POINTS`.
    """
    step = -(-len(values) // max(_FEWEST_POINTS, _LINE_POINTS // runs))
    if step < 2:
        return np.arange(len(values))
    highest = [
        start + int(np.argmax(np.nan_to_num(values[start : start + step], nan=-np.inf)))
        for start in range(0, len(values), step)
    ]
    return np.unique([*highest, *np.flatnonzero(np.isnan(values))])


def _pieces(points: Floats, values: Floats) -> tuple[list[NDArray[np.float64]], Floats]:
    """Return at most about `_SEGMENTS` pieces of a path, none over a gap, and their mean values."""
    step = max(1, -(-len(points) // _SEGMENTS))
    pieces, means = [], []
    for start in range(0, len(points) - 1, step):
        piece, value = points[start : start + step + 1], values[start : start + step + 1]
        if np.isfinite(value).any():
            pieces.append(piece)
            means.append(float(np.nanmean(value)))
    return pieces, np.array(means)


def _equal(axes: "Axes", view: View) -> None:
    _, i, j, sign = view
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{'xyz'[i]}, m", ylabel=f"{'−' if sign < 0 else ''}{'xyz'[j]}, m")
    axes.margins(0.06)
