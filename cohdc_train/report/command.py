"""`cohdc report`: folders of runs in, one HTML page out."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import Enum
from pathlib import Path

from cohdc_train.errors import DataError
from cohdc_train.files import check_folder, list_files, write_text
from cohdc_train.report.images import embed
from cohdc_train.report.page import Figure, Page, Section, Table
from cohdc_train.report.scores import (
    BENCH_FILE,
    bench_page,
    read_bench,
    read_evaluation,
    validated_scores,
    validation_page,
)
from cohdc_train.report.slam_run import SlamRun, find_groundtruth, read_slam_run
from cohdc_train.report.slam_sections import slam_page
from cohdc_train.report.training_run import VALIDATION_IMAGES, logs, read_training_run
from cohdc_train.report.training_sections import training_page
from cohdc_train.trajectory.trajectory import Trajectory

PAGE = "report.html"
_NAMED = 3  # runs that stand in a page's title


class Kind(Enum):
    """Command that wrote a folder or a file."""

    SLAM = "SLAM runs"
    TRAINING = "Trainings"
    VALIDATION = "Validations"
    EVALUATION = "Evaluations"
    BENCH = "Benchmarks"


def report(
    runs: list[Path],
    groundtruth: Path | None = None,
    out: Path | None = None,
    title: str | None = None,
) -> Path:
    """Write one HTML page of a run, or of several beside each other.

    A run is a folder of `cohdc slam`, `cohdc fit` or `cohdc bench`, or a JSON file of `cohdc
    evaluate` or `cohdc validate`, or a folder of such files. The page holds its images and plots
    itself. Returns the page. Raises DataError naming a file of a run that cannot be used.

    Args:
        runs: folders and files; of several the page compares those of one kind.
        groundtruth: TUM file for all SLAM runs; groundtruth.txt of a run's sequence when not given
            and there.
        out: the HTML file; when not given, report.html in the folder of a single run, and in the
            current folder for several.
        title: of the page; the name of the folder when not given.
    """
    if not runs:
        raise DataError("give at least one folder of a run")
    kinds = {path: kind_of(path) for path in runs}
    folder = runs[0] if runs[0].is_dir() else runs[0].parent
    folder = folder if len(runs) == 1 else Path()
    page = folder / PAGE if out is None else out
    if page.is_dir():
        raise DataError(f"{page}: is a folder; --out names the page")
    if out is None:
        check_folder(folder, "report", [PAGE])
    labels = dict(zip(runs, labels_of(runs), strict=True))
    pages = [
        made
        for kind in Kind
        for made in _pages(kind, {labels[p]: p for p in kinds if kinds[p] is kind}, groundtruth)
    ]
    names = list(labels.values())
    default = f"{len(names)} runs" if len(names) > _NAMED else ", ".join(names)
    _write(page, _joined(title or default, pages))
    if out is None:
        list_files(folder, "report", [PAGE])
    print(f"report: {page}")
    return page


def write_report(
    out: Path,
    title: str,
    groundtruth: Path | None,
    runs: Mapping[str, Path],
    overlays: Sequence[Path] = (),
    tables: Sequence[Table] = (),
) -> None:
    """Write one HTML page about SLAM runs on a sequence.

    Args:
        out: the HTML file, written whole or not at all.
        title: of the page.
        groundtruth: TUM file, None where there is none.
        runs: label -> folder written by `cohdc slam`.
        overlays: JPEG or PNG images of predicted masks.
        tables: shown first.

    Raises:
        DataError: a file of a run or an image cannot be used; it is named.
    """
    truth = None if groundtruth is None else Trajectory.load_tum(groundtruth)
    page = slam_page(title, [read_slam_run(*item, truth) for item in runs.items()], truth)
    images = len(overlays) + 8 * len(runs)
    masks = [Figure(file.stem, image=embed(file, images)) for file in overlays]
    summary = [Section(table.title, tables=[_untitled(table)]) for table in tables]
    sections = [*summary, *page.sections, Section("Predicted masks", figures=masks)]
    _write(out, Page(page.title, page.kind, page.lead, page.facts, sections))


def kind_of(path: Path) -> Kind:
    """Return what wrote a folder or a file. Raises DataError where nothing of cohdc did."""
    if not path.exists():
        raise DataError(f"{path}: no such file or folder")
    if path.is_file():
        files = [path]
    else:
        if (path / "trajectory.txt").is_file() or (path / "frames.csv").is_file():
            return Kind.SLAM
        if logs(path):
            return Kind.TRAINING
        if (path / BENCH_FILE).is_file():
            return Kind.BENCH
        files = sorted(path.glob("*.json"))
        if validated_scores(path) or any((path / name).is_file() for name in VALIDATION_IMAGES):
            return Kind.VALIDATION
    if any(validated_scores(file) for file in files):
        return Kind.VALIDATION
    if any(read_evaluation("", file) is not None for file in files):
        return Kind.EVALUATION
    raise DataError(
        f"{path}: is no run; give a folder of cohdc slam, fit or bench, or what cohdc evaluate "
        "or validate wrote"
    )


def labels_of(paths: Sequence[Path]) -> list[str]:
    """Return a name for each path, as short as they stay different."""
    resolved = [path.resolve() for path in paths]
    longest = max(len(path.parts) for path in resolved)
    for count in range(1, longest + 1):
        labels = ["/".join(path.with_suffix("").parts[-count:]) for path in resolved]
        if len(set(labels)) == len(labels):
            return labels
    raise DataError(f"{paths[0]}: is given twice")


def _pages(kind: Kind, runs: Mapping[str, Path], groundtruth: Path | None) -> list[Page]:
    """Return the pages of the runs of one kind; SLAM runs have one per sequence."""
    if not runs:
        return []
    title = ", ".join(runs)
    if kind is Kind.TRAINING:
        return [training_page(title, [read_training_run(*item) for item in runs.items()])]
    if kind is Kind.VALIDATION:
        return [validation_page(title, runs)]
    if kind is Kind.BENCH:
        return [bench_page(label, read_bench(folder)) for label, folder in runs.items()]
    if kind is Kind.EVALUATION:
        return [slam_page(title, _evaluations(runs), None)]
    return _slam_pages(runs, groundtruth)


def _slam_pages(runs: Mapping[str, Path], groundtruth: Path | None) -> list[Page]:
    groups: dict[Path | None, dict[str, Path]] = {}
    for label, folder in runs.items():
        file = groundtruth if groundtruth is not None else find_groundtruth(folder)
        groups.setdefault(file, {})[label] = folder
    pages = []
    for file, members in groups.items():
        truth = None if file is None else Trajectory.load_tum(file)
        loaded = [read_slam_run(label, folder, truth) for label, folder in members.items()]
        pages.append(slam_page(", ".join(members), loaded, truth))
    return pages


def _evaluations(runs: Mapping[str, Path]) -> list[SlamRun]:
    found = []
    for label, path in runs.items():
        for file in [path] if path.is_file() else sorted(path.glob("*.json")):
            name = label if path.is_file() else f"{label}/{file.stem}"
            run = read_evaluation(name, file)
            found += [] if run is None else [run]
    return found


def _joined(title: str, pages: Sequence[Page]) -> Page:
    """Return one page of several: their facts become the first of their sections."""
    if len(pages) == 1:
        (page,) = pages
        return Page(title, page.kind, page.lead, page.facts, page.sections)
    sections = []
    for page in pages:
        sections.append(Section(f"{page.kind}: {page.title}", page.lead, page.facts, divider=True))
        sections += page.sections
    return Page(title, "Report", sections=sections)


def _untitled(table: Table) -> Table:
    return replace(table, title="")


def _write(out: Path, page: Page) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    write_text(out, page.html())
