"""The parts of a page about SLAM runs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cohdc_train.report import slam_facts
from cohdc_train.report.map_view import draw_map
from cohdc_train.report.page import Figure, Page, Section
from cohdc_train.report.pictures import embed, embed_image
from cohdc_train.report.slam_plots import (
    CAMERA_VIEWS,
    TRUTH_VIEWS,
    draw_error_path,
    draw_errors,
    draw_paths,
    draw_strip,
    strip_tops,
)
from cohdc_train.report.slam_run import SlamRun
from cohdc_train.report.svg import Draw, Size, svg
from cohdc_train.report.tables import options
from cohdc_train.trajectory.trajectory import Trajectory

_SQUARE, _WIDE, _NARROW = Size(430, 400), Size(1080, 300), Size(380, 330)
_STRIP_WIDE, _STRIP_NARROW = Size(1080, 390), Size(380, 400)
_ERROR_PATHS = 6  # runs whose paths are drawn one by one
_WORST = {1: 6, 2: 6, 3: 4}  # runs -> worst frames of each; of more runs two


def slam_page(title: str, runs: Sequence[SlamRun], truth: Trajectory | None) -> Page:
    """Return the page of one or more runs on one sequence."""
    sections = slam_sections(runs, truth)
    if len(runs) == 1:
        (run,) = runs
        return Page(title, "SLAM run", [slam_facts.lead(run)], slam_facts.facts(run), sections)
    return Page(title, f"Comparison of {len(runs)} SLAM runs", sections=sections)


def slam_sections(runs: Sequence[SlamRun], truth: Trajectory | None) -> list[Section]:
    """Return all parts below the facts. truth: the whole ground truth, None where there is none."""
    placed = list(enumerate(runs))
    summary = [Section("Runs side by side", tables=[slam_facts.comparison(runs)])]
    differing, every = options({run.label: run.config for run in runs})
    return [
        *(summary if len(runs) > 1 else []),
        _trajectories(placed, truth),
        _errors(placed),
        *_strips(placed),
        _maps(runs),
        Section("Time", tables=slam_facts.time_table(runs)),
        Section("Options", tables=differing, folded=every),
    ]


def _trajectories(runs: Sequence[tuple[int, SlamRun]], truth: Trajectory | None) -> Section:
    if all(run.trajectory is None for _, run in runs):
        return Section("Trajectory")
    aligned = truth is not None and any(run.matched is not None for _, run in runs)
    views = TRUTH_VIEWS if aligned else CAMERA_VIEWS
    title = "Trajectory against ground truth" if aligned else "Trajectory"
    how = ["Rigidly aligned, equal axes; gaps are where tracking was lost."]
    shown = [
        (place, run) for place, run in runs if not aligned or run.matched is not None
    ]  # what has no truth lies in another world
    figures = [
        Figure(
            view[0],
            wide=svg(draw_paths(view, truth if aligned else None, shown), _SQUARE, f"path{k}"),
        )
        for k, view in enumerate(views)
    ]
    return Section(
        title, how if aligned else [how[0].replace("Rigidly aligned, e", "E")], figures=figures
    )


def _errors(runs: Sequence[tuple[int, SlamRun]]) -> Section:
    tables = slam_facts.error_table([run for _, run in runs])
    shown = [(place, run) for place, run in runs if run.errors() is not None]
    if not shown:
        return Section("Errors", tables=tables)
    figures = [_two("Error over time", draw_errors(shown), _WIDE, _NARROW, "errors")]
    largest = max(float(np.nanmax(run.errors()[1])) for _, run in shown)  # type: ignore[index]
    for place, run in shown[:_ERROR_PATHS]:
        name = "Where the error is" if len(runs) == 1 else run.label
        drawing = draw_error_path(TRUTH_VIEWS[0], run, largest)
        caption = (
            "From above; the color scale is the same for every run."
            if len(runs) > 1
            else "From above."
        )
        figures.append(Figure(name, caption, wide=svg(drawing, _SQUARE, f"error-path{place}")))
    return Section("Errors", tables=tables, figures=figures)


def _strips(runs: Sequence[tuple[int, SlamRun]]) -> list[Section]:
    """Return a part per run: the strip of its frames, and images of the worst."""
    tops = strip_tops([run for _, run in runs])
    sections = []
    for place, run in runs:
        if run.frames is None or not len(run.frames):
            continue
        worst = _worst_frames(run, _WORST.get(len(runs), 2))
        letters = {index: chr(ord("A") + k) for k, (index, _) in enumerate(worst)}
        caption = "Red: lost. Ticks at the top: keyframes. Letters: the images below."
        caption = caption if letters else caption.rpartition(" Letters")[0]
        drawing = draw_strip(run, letters, tops)
        strip = _two("Every frame", drawing, _STRIP_WIDE, _STRIP_NARROW, f"strip{place}", caption)
        title = "Where tracking was weak" + (f": {run.label}" if len(runs) > 1 else "")
        images = [
            Figure(_frame_title(run, index, letters[index]), picture=embed(file, 8 * len(runs)))
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
    time = run.frames.stamps[index] - run.start
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
            figures.append(Figure(title, picture=embed(file, images)))
        if figures:
            break
    return figures


def _maps(runs: Sequence[SlamRun]) -> Section:
    figures = []
    for run in runs:
        image = draw_map(run)
        name = "Map" if len(runs) == 1 else run.label
        if image is not None:
            picture = embed_image(image, 8 * len(runs))
            figures.append(Figure(name, "Points of the map; orange: the camera.", picture=picture))
        elif (run.folder / "map.png").is_file():
            picture = embed(run.folder / "map.png", 8 * len(runs))
            figures.append(Figure(name, "The camera's path in red.", picture=picture))
    return Section("Map from above", figures=figures)


def _two(title: str, draw: Draw, wide: Size, narrow: Size, name: str, caption: str = "") -> Figure:
    """Return a figure over the page's whole width, drawn once for a screen, once for a telephone."""
    drawn = svg(draw, wide, name), svg(draw, narrow, f"{name}-narrow")
    return Figure(title, caption, *drawn, span=True)
