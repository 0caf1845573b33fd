"""The parts of a page about SLAM runs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cohdc_train.report import slam_facts
from cohdc_train.report.images import embed, embed_image
from cohdc_train.report.map_view import draw_map
from cohdc_train.report.page import Figure, Page, Section
from cohdc_train.report.slam_plots import (
    CAMERA_VIEWS,
    TRUTH_VIEWS,
    View,
    draw_error_path,
    draw_errors,
    draw_paths,
    draw_strip,
    strip_scale,
)
from cohdc_train.report.slam_run import SlamRun
from cohdc_train.report.svg import Draw, Size, svg
from cohdc_train.report.tables import options
from cohdc_train.trajectory.trajectory import Trajectory

_SQUARE, _WIDE, _NARROW = Size(370, 350), Size(1080, 300), Size(380, 330)
_STRIP_WIDE, _STRIP_NARROW = Size(1080, 390), Size(380, 400)
_DETAILED = 10  # runs whose frames and maps are shown: a page is to stay below 5 MB
_ERROR_PATHS = 6  # runs whose paths are drawn one by one
_WORST = {1: 6, 2: 6, 3: 4}  # runs -> worst frames of each; of more runs two


def slam_page(title: str, runs: Sequence[SlamRun], truth: Trajectory | None) -> Page:
    """Return the page of one or more runs on one sequence."""
    sections = slam_sections(runs, truth)
    if len(runs) == 1:
        (run,) = runs
        return Page(title, "SLAM run", [slam_facts.lead(run)], slam_facts.facts(run), sections)
    common = slam_facts.common_settings(runs)
    return Page(title, f"Comparison of {len(runs)} SLAM runs", facts=common, sections=sections)


def slam_sections(runs: Sequence[SlamRun], truth: Trajectory | None) -> list[Section]:
    """Return all parts below the facts. truth: the whole ground truth, None where there is none."""
    placed = list(enumerate(runs))
    summary = [Section("Runs side by side", tables=[slam_facts.comparison(runs)])]
    differing, every = options({run.label: run.config for run in runs})
    return [
        *(summary if len(runs) > 1 else []),
        _trajectories(placed, truth),
        _errors(placed),
        *(_details(placed) if len(runs) <= _DETAILED else [_too_many(len(runs))]),
        Section("Time", tables=slam_facts.time_table(runs)),
        Section("Options", tables=differing, folded=every),
    ]


def _details(runs: Sequence[tuple[int, SlamRun]]) -> list[Section]:
    return [*_strips(runs), _maps([run for _, run in runs])]


def _too_many(runs: int) -> Section:
    words = f"Of {runs} runs there are no frames and maps; a page of {_DETAILED} or fewer has them."
    return Section("Where tracking was weak", [words])


def _trajectories(runs: Sequence[tuple[int, SlamRun]], truth: Trajectory | None) -> Section:
    if all(run.trajectory is None for _, run in runs):
        return Section("Trajectory")
    shown = [(place, run) for place, run in runs if run.matched is not None]
    if truth is None or not shown:
        figures = [_path(k, view, None, runs) for k, view in enumerate(CAMERA_VIEWS)]
        words = ["Meters from the first camera, equal axes; gaps are where tracking was lost."]
        return Section("Trajectory", words, figures=figures)
    meanwhile = _during(truth, [run for _, run in shown])
    views = TRUTH_VIEWS if len(runs) > 1 else TRUTH_VIEWS[:2]  # the third place is the error's
    figures = [_path(k, view, meanwhile, shown) for k, view in enumerate(views)]
    if len(runs) == 1:
        figures += _error_paths(shown, 1)
    words = ["Rigidly aligned to the ground truth, equal axes; gaps are where tracking was lost."]
    return Section("Trajectory", words, figures=figures)


def _path(
    number: int, view: View, truth: Trajectory | None, runs: Sequence[tuple[int, SlamRun]]
) -> Figure:
    return Figure(view[0], wide=svg(draw_paths(view, truth, runs), _SQUARE, f"path{number}"))


def _during(truth: Trajectory, runs: Sequence[SlamRun]) -> Trajectory:
    """Return the part of the ground truth in which there were frames."""
    spans = [run.span() for run in runs]
    first, last = min(start for start, _ in spans), max(end for _, end in spans)
    inside = np.flatnonzero((truth.timestamps >= first) & (truth.timestamps <= last))
    return truth.take(inside) if len(inside) else truth


def _error_paths(runs: Sequence[tuple[int, SlamRun]], total: int) -> list[Figure]:
    errors = [errors for _, run in runs if (errors := run.errors()) is not None]
    largest = max(float(np.nanmax(distances)) for _, distances in errors)
    figures = []
    for place, run in runs[:_ERROR_PATHS]:
        title = "Where the error is" if total == 1 else f"Where the error is: {run.label}"
        caption = "From above." if total == 1 else "From above; one color scale for all runs."
        drawing = draw_error_path(TRUTH_VIEWS[0], run, largest)
        figures.append(Figure(title, caption, wide=svg(drawing, _SQUARE, f"error-path{place}")))
    return figures


def _errors(runs: Sequence[tuple[int, SlamRun]]) -> Section:
    tables = slam_facts.error_table([run for _, run in runs])
    shown = [(place, run) for place, run in runs if run.matched is not None]
    if not shown:
        return Section("Errors", tables=tables)
    over_time = _two("Error over time", draw_errors(shown), _WIDE, _NARROW, "errors")
    figures = [over_time, *(_error_paths(shown, len(runs)) if len(runs) > 1 else [])]
    return Section("Errors", tables=tables, figures=figures)


def _strips(runs: Sequence[tuple[int, SlamRun]]) -> list[Section]:
    """Return a part per run: the strip of its frames, and images of the worst."""
    scale = strip_scale([run for _, run in runs])
    sections = []
    for place, run in runs:
        if run.frames is None or not len(run.frames):
            continue
        worst = _worst_frames(run, _WORST.get(len(runs), 2))
        letters = {index: chr(ord("A") + k) for k, (index, _) in enumerate(worst)}
        caption = "Red: lost. Ticks: keyframes. Masked: pixels not used. Letters: the images below."
        caption = caption if letters else caption.rpartition(" Letters")[0]
        drawing = draw_strip(run, letters, scale)
        strip = _two("Every frame", drawing, _STRIP_WIDE, _STRIP_NARROW, f"strip{place}", caption)
        title = "Where tracking was weak" + (f": {run.label}" if len(runs) > 1 else "")
        images = [
            Figure(_frame_title(run, index, letters[index]), image=embed(file, 8 * len(runs)))
            for index, file in worst
        ]
        pairs = [] if worst else _pairs(run, 8 * len(runs))
        sections.append(
            Section(title, slam_facts.where_it_went_wrong(run), figures=[strip, *images, *pairs])
        )
    return sections


def _worst_frames(run: SlamRun, count: int) -> list[tuple[int, Path]]:
    """Return index and image of the worst frames that the run stored, in the order of time."""
    assert run.frames is not None
    indices = {name: index for index, name in enumerate(run.frames.names)}
    stored = []
    for file in sorted((run.folder / "pictures").glob("*_worst.jpg")):
        index = indices.get(file.name.removesuffix("_worst.jpg"))
        if index is not None:
            lost = bool(run.frames.lost[index])
            stored.append((-1.0 if lost else run.frames.columns["inliers"][index], index, file))
    return sorted((index, file) for _, index, file in sorted(stored)[:count])


def _frame_title(run: SlamRun, index: int, letter: str) -> str:
    assert run.frames is not None
    time = run.frames.timestamps[index] - run.start
    columns = run.frames.columns
    state = "lost" if run.frames.lost[index] else f"{columns['inliers'][index]:.0f} inliers"
    masked = columns["culled_share"][index]
    share = f", {100 * masked:.0f} % masked" if masked else ""
    return f"{letter}: {time:.1f} s, frame {index + 1}, {state}{share}"


def _pairs(run: SlamRun, images: int) -> list[Figure]:
    """Return images of keypoints before and after masking, of a run that stored nothing else."""
    figures = []
    for kind, what in (("after", "keypoints used, mask outlined"), ("before", "all keypoints")):
        for file in sorted((run.folder / "pictures").glob(f"*_{kind}.jpg"))[:3]:
            title = f"{file.name.removesuffix(f'_{kind}.jpg')}: {what}"
            figures.append(Figure(title, image=embed(file, images)))
        if figures:
            break
    return figures


def _maps(runs: Sequence[SlamRun]) -> Section:
    figures = []
    for run in runs:
        drawn, stored = draw_map(run), run.folder / "map.png"
        name = "Map" if len(runs) == 1 else run.label
        if drawn is not None:
            image = embed_image(drawn, 8 * len(runs))
            caption = "Points of the map; orange: path of the camera, from the white dot."
        elif stored.is_file():
            image, caption = embed(stored, 8 * len(runs)), "The camera's path in red."
        else:
            continue
        figures.append(Figure(name, caption, image=image, large=True))
    return Section("Map from above", figures=figures)


def _two(title: str, draw: Draw, wide: Size, narrow: Size, name: str, caption: str = "") -> Figure:
    """Return a figure over the whole width, drawn once for a screen and once for a telephone."""
    drawn = svg(draw, wide, name), svg(draw, narrow, f"{name}-narrow")
    return Figure(title, caption, *drawn, span=True)
