"""The report: self-contained, complete, and honest about runs that lost their way."""

import base64
import json
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from cohdc_train.errors import DataError
from cohdc_train.report import Table, report, write_report
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory


class Page(HTMLParser):
    """Collects what a page shows and what it would have to fetch."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.images: list[str] = []
        self.cells: list[str] = []
        self.heads: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        fields = dict(attrs)
        assert tag not in ("script", "link", "iframe"), "the page must need nothing beside itself"
        if tag == "img":
            self.images.append(fields["src"] or "")
        elif tag not in ("meta",):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> closes something else"

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "td":
            self.cells.append(data)
        if self.open and self.open[-1] in ("h2", "h3"):
            self.heads.append(data)


def trajectory(noise: float = 0.0, n: int = 60) -> Trajectory:
    time = np.arange(n) / 30
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, 3] = np.stack([np.sin(time), np.cos(time), 0.3 * time], axis=1)
    poses[:, :3, 3] += noise * np.random.default_rng(1).normal(size=(n, 3))
    return Trajectory(100 + time, poses)


def run_folder(folder: Path, noise: float, pictures: bool = True) -> Path:
    (folder / "pictures").mkdir(parents=True)
    estimate = trajectory(noise)
    estimate.save_tum(folder / "trajectory.txt")
    metrics = {"coverage": 1.0, "frames": 60, "ms": {"track": {"p50": 11.25, "p95": 20.5}}}
    (folder / "metrics.json").write_text(json.dumps({**metrics, **score(trajectory(), estimate)}))
    for kind in ("before", "after") if pictures else ("before",):
        cv2.imwrite(
            str(folder / "pictures" / f"100.5_{kind}.jpg"), np.full((48, 64, 3), 90, np.uint8)
        )
    return folder


@pytest.fixture
def truth_file(tmp_path: Path) -> Path:
    trajectory().save_tum(tmp_path / "groundtruth.txt")
    return tmp_path / "groundtruth.txt"


def test_page_holds_everything_inside_itself(tmp_path: Path, truth_file: Path) -> None:
    overlay = tmp_path / "0001_overlay.jpg"
    cv2.imwrite(str(overlay), np.full((48, 64, 3), 200, np.uint8))
    runs = {
        "without": run_folder(tmp_path / "a", 0.2, pictures=False),
        "with": run_folder(tmp_path / "b", 0.001),
    }
    table = Table("Summary <of all>", ["what", "value"], [["AP50", "0.75"], ["a & b", "<1"]])
    write_report(tmp_path / "page" / "report.html", "Demo", truth_file, runs, [overlay], [table])
    page = Page((tmp_path / "page" / "report.html").read_text("utf-8"))
    assert page.heads == [
        "Summary <of all>",
        "Trajectory scores",
        "Coverage and time per stage",
        "Trajectory against ground truth",
        "Absolute trajectory error over time",
        "Predicted masks",
        "Features before and after culling",
    ]
    assert {"a & b", "<1", "without", "with", "11.2", "20.5", "100.0 %"} <= set(page.cells)
    kinds = [source.split(";")[0] for source in page.images]
    assert kinds == ["data:image/svg+xml"] * 3 + ["data:image/jpeg"] * 3, (
        "the run without masks has no picture of culling"
    )
    for source in page.images:
        content = base64.b64decode(source.partition("base64,")[2], validate=True)
        assert content.startswith((b"\xff\xd8", b"<?xml"))
    assert [file.name for file in (tmp_path / "page").iterdir()] == ["report.html"]


def test_the_map_of_every_run_is_shown(tmp_path: Path, truth_file: Path) -> None:
    runs = {name: run_folder(tmp_path / name, 0.01, pictures=False) for name in ("a", "b")}
    cv2.imwrite(str(runs["b"] / "map.png"), np.full((48, 64, 3), 200, np.uint8))
    write_report(tmp_path / "report.html", "Map", truth_file, runs)
    page = Page((tmp_path / "report.html").read_text("utf-8"))
    assert page.heads[-1] == "Map from above"
    shown = [source for source in page.images if source.startswith("data:image/png")]
    assert [base64.b64decode(source.partition("base64,")[2]) for source in shown] == [
        (runs["b"] / "map.png").read_bytes()
    ]


def test_same_run_same_page(tmp_path: Path, truth_file: Path) -> None:
    runs = {"with": run_folder(tmp_path / "b", 0.01)}
    for name in ("one.html", "two.html"):
        write_report(tmp_path / name, "Demo", truth_file, runs)
    assert (tmp_path / "one.html").read_bytes() == (tmp_path / "two.html").read_bytes()


def test_lost_run_keeps_its_row_without_a_plot(tmp_path: Path, truth_file: Path) -> None:
    folder = run_folder(tmp_path / "lost", 0.0)
    (folder / "metrics.json").write_text(
        json.dumps({"coverage": 0.0, "ms": {"track": {"p50": 1.0, "p95": 2.0}}})
    )
    (folder / "trajectory.txt").write_text("# nothing\n")
    write_report(tmp_path / "report.html", "Lost", truth_file, {"lost": folder})
    page = Page((tmp_path / "report.html").read_text("utf-8"))
    assert "0.0 %" in page.cells
    assert "Trajectory against ground truth" not in page.heads


def test_what_is_missing_is_named(tmp_path: Path, truth_file: Path) -> None:
    folder = run_folder(tmp_path / "run", 0.01)
    with pytest.raises(DataError, match=r"gone\.jpg"):
        write_report(tmp_path / "r.html", "t", truth_file, {"run": folder}, [tmp_path / "gone.jpg"])
    (folder / "metrics.json").write_text("{")
    with pytest.raises(DataError, match=r"metrics\.json"):
        write_report(tmp_path / "r.html", "t", truth_file, {"run": folder})
    assert not (tmp_path / "r.html").exists()


def test_uneven_table_is_refused() -> None:
    with pytest.raises(ValueError, match="2 cells"):
        Table("t", ["a", "b"], [["1"]])


def test_the_verb_finds_the_ground_truth_of_the_run_and_compares(tmp_path: Path) -> None:
    (tmp_path / "sequence").mkdir()
    trajectory().save_tum(tmp_path / "sequence" / "groundtruth.txt")
    ours, other = run_folder(tmp_path / "with", 0.001), run_folder(tmp_path / "without", 0.1)
    (ours / "config.yaml").write_text(f"sequence: {tmp_path / 'sequence'}")
    assert report(ours, against=other) == ours / "report.html"
    page = Page((ours / "report.html").read_text())
    assert {"with", "without, against"} <= set(page.cells)
    assert "Trajectory against ground truth" in page.heads
    assert "Absolute trajectory error over time" in page.heads


def test_report_keeps_a_page_it_did_not_write(tmp_path: Path) -> None:
    ours = run_folder(tmp_path / "run", 0.001)
    (ours / "config.yaml").write_text("sequence: nowhere")
    (ours / "report.html").write_text("mine")
    with pytest.raises(DataError, match=r"holds report\.html, not written by"):
        report(ours)
    assert (ours / "report.html").read_text() == "mine"
    (ours / "report.html").unlink()
    assert report(ours).read_bytes() == report(ours).read_bytes()


def test_a_run_without_ground_truth_has_its_trajectory_all_the_same(tmp_path: Path) -> None:
    ours = run_folder(tmp_path / "live", 0.001)
    (ours / "config.yaml").write_text("sequence: nowhere")
    page = Page(report(ours, out=tmp_path / "page.html").read_text())
    assert "Trajectory" in page.heads
    assert "Absolute trajectory error over time" not in page.heads
    assert len(page.images) > 2


@pytest.mark.parametrize(
    "metrics", ["{}", "[]", '{"coverage": 1, "ms": [3]}', '{"coverage": 1, "ms": {"track": 3}}']
)
def test_metrics_of_another_kind_are_named(tmp_path: Path, metrics: str) -> None:
    ours = run_folder(tmp_path / "run", 0.001)
    (ours / "config.yaml").write_text("sequence: null")
    (ours / "metrics.json").write_text(metrics)
    with pytest.raises(DataError, match=r"metrics\.json: cannot be read as metrics"):
        report(ours)
    with pytest.raises(DataError, match=r"is a folder; --out names the page"):
        report(ours, out=tmp_path)


def test_a_folder_that_is_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"config\.yaml: cannot be read; is .* a folder of cohdc slam"
    ):
        report(tmp_path)
