"""The page of SLAM runs: facts first, honest about loss, and the same for the same run."""

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from report_runs import RATE, START, Page, trajectory, write_slam_run, write_truth

from cohdc_train.errors import DataError
from cohdc_train.report import Table, report, write_report
from cohdc_train.report.map_view import draw_map, read_points, scale_length
from cohdc_train.report.slam_plots import _thinned
from cohdc_train.report.slam_run import find_groundtruth, read_slam_run
from cohdc_train.trajectory.trajectory import Trajectory

LOST = range(20, 35)


@pytest.fixture
def truth_file(tmp_path: Path) -> Path:
    """Write the ground truth into a sequence's folder."""
    return write_truth(tmp_path / "room")


def open_page(page: Path) -> Page:
    """Read a page, which must be small enough to be sent around."""
    assert page.stat().st_size < 5_000_000
    return Page(page.read_text("utf-8"))


def test_page_of_a_run_opens_with_its_facts(tmp_path: Path, truth_file: Path) -> None:
    run = write_slam_run(tmp_path / "walk", 0.001, LOST, truth_file.parent)
    page = open_page(report([run]))
    assert list(page.facts) == [
        *("Frames tracked", "Frames lost", "Translation error (ATE RMSE)", "Trajectory length"),
        *("Keyframes", "Loops closed", "Speed", "Camera", "Masks", "Seed", "Sequence", "Version"),
    ]
    assert page.facts["Frames tracked"] == "45 of 60"
    assert page.facts["Frames lost"] == "15"
    assert page.facts["Speed"] == "21.5 frames/s"
    assert page.facts["Masks"] == "person.onnx"
    assert page.heads == [
        *("Trajectory", "Errors", "Where tracking was weak", "Map from above", "Time", "Options"),
    ]
    assert "Tracking was lost at 0.7 s (15 frames)." in page.text
    error = json.loads((run / "metrics.json").read_text())["ate_m"]["rmse"]
    assert page.facts["Translation error (ATE RMSE)"] == f"{error:.4f} m"


def test_page_needs_nothing_beside_itself(tmp_path: Path, truth_file: Path) -> None:
    overlay = tmp_path / "0001_overlay.jpg"
    cv2.imwrite(str(overlay), np.full((48, 64, 3), 200, np.uint8))
    runs = {"without": write_slam_run(tmp_path / "a", 0.2)}
    runs["with"] = write_slam_run(tmp_path / "b", worst=(3, 40))
    table = Table("Summary <of all>", ["what", "value"], [["AP50", "0.75"], ["a & b", "<1"]])
    write_report(tmp_path / "page" / "report.html", "Demo", truth_file, runs, [overlay], [table])
    page = open_page(tmp_path / "page" / "report.html")
    assert page.heads[0] == "Summary <of all>"
    assert page.heads[-1] == "Predicted masks"
    assert {"a & b", "<1", "without", "with", "11.2", "20.5"} <= set(page.cells)
    for source in page.images:
        content = base64.b64decode(source.partition("base64,")[2], validate=True)
        assert content.startswith((b"\xff\xd8", b"\x89PNG"))
    assert len(page.images) == 5, "two maps, two of the worst frames, and the overlay"
    assert [file.name for file in (tmp_path / "page").iterdir()] == ["report.html"]


def test_worst_frames_are_shown_with_letters_in_the_order_of_time(
    tmp_path: Path, truth_file: Path
) -> None:
    run = write_slam_run(tmp_path / "run", lost=LOST, sequence=truth_file.parent, worst=(50, 2, 30))
    page = open_page(report([run]))
    shown = [caption for caption in page.captions if caption[1:3] == ": "]
    assert shown == [
        "A: 0.1 s, frame 3, 102 inliers, 2 % masked",
        "B: 1.0 s, frame 31, lost, 2 % masked",
        "C: 1.7 s, frame 51, 150 inliers, 1 % masked",
    ]


def test_gap_in_tracking_is_a_gap_in_every_line(tmp_path: Path, truth_file: Path) -> None:
    folder = write_slam_run(tmp_path / "run", lost=(30,))  # one frame: a pause of 0.07 s alone
    run = read_slam_run("run", folder, Trajectory.load_tum(truth_file))
    timestamps, positions = run.path()
    errors = run.errors()
    assert errors is not None
    for row in (timestamps, positions[:, 0], *errors):
        assert np.flatnonzero(np.isnan(row)).tolist() == [30]
    whole = np.linalg.norm(np.diff(trajectory(0.001).positions, axis=0), axis=1)
    assert run.length() == pytest.approx(whole.sum() - whole[29] - whole[30])


def test_comparison_has_a_row_per_run_and_marks_the_best(tmp_path: Path, truth_file: Path) -> None:
    options: dict[str, object] = {"model": None}
    room = truth_file.parent
    runs = [
        write_slam_run(tmp_path / "plain", 0.1, LOST, room, options=options),
        write_slam_run(tmp_path / "masks", 0.001, (), room),
        write_slam_run(tmp_path / "other", 0.01, (), room),
    ]
    out = tmp_path / "page.html"
    assert report(runs, out=out) == out
    page = open_page(out)
    assert page.heads[:2] == ["Runs side by side", "Trajectory"]
    first = page.cells[: page.cells.index("masks")]
    assert first[:4] == ["plain", "none", "75.0", "15"]
    text = out.read_text("utf-8")
    best = json.loads((runs[1] / "metrics.json").read_text())["ate_m"]["rmse"]
    assert f'<td class="best">{best:.4f}</td>' in text
    assert {"model", "none", "person.onnx"} <= set(page.cells[page.cells.index("model") :][:4])
    assert "Where the error is: masks" in page.captions
    assert page.facts["Sequence"] == "room"


@pytest.mark.slow
@pytest.mark.parametrize("number", [10, 11])
def test_page_of_many_runs_stays_small(tmp_path: Path, truth_file: Path, number: int) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    runs = []
    for k in range(number):
        folder = write_slam_run(tmp_path / f"run{k}", 0.01, sequence=truth_file.parent)
        for index in (3, 20, 40, 50):
            stamp = f"{START + index / RATE:.6f}"
            cv2.imwrite(str(folder / "pictures" / f"{stamp}_worst.jpg"), noise)
        runs.append(folder)
    page = open_page(report(runs, out=tmp_path / "page.html"))
    assert len(page.images) == (30 if number == 10 else 0), "a map and two frames of each run"
    assert ("Of 11 runs there are no frames and maps" in page.text) == (number == 11)


def test_long_run_is_drawn_with_its_peaks_and_gaps() -> None:
    values = np.ones(100_000)
    values[77_777], values[5_000] = 9, np.nan
    kept = _thinned(values, 2)
    assert len(kept) < 3_000
    assert {5_000, 77_777} <= set(kept.tolist())
    assert _thinned(values[:100], 2).tolist() == list(range(100))


def test_runs_of_two_sequences_are_not_laid_over_each_other(tmp_path: Path) -> None:
    runs = [
        write_slam_run(tmp_path / name, sequence=write_truth(tmp_path / f"{name}_room").parent)
        for name in ("a", "b")
    ]
    page = open_page(report(runs, out=tmp_path / "page.html"))
    assert [head for head in page.heads if head.startswith("SLAM run")] == [
        *("SLAM run: a", "SLAM run: b"),
    ]
    assert page.heads.count("Trajectory") == 2


def test_words_of_a_user_are_escaped(tmp_path: Path, truth_file: Path) -> None:
    name = "<script>alert(1)</script>".replace("/", "\u2215")
    options: dict[str, object] = {"<b>": "<i>&"}
    run = write_slam_run(tmp_path / name, sequence=truth_file.parent, options=options)
    other = write_slam_run(tmp_path / "b\"'><img src=x>", sequence=truth_file.parent)
    page = report([run, other], title="<u>title", out=tmp_path / "page.html")
    text = page.read_text("utf-8")
    for words in (name, "<b>", "<i>", "<img src=x>", "<u>title"):
        assert words not in text
    assert open_page(page).cells.count("<i>&") == 2
    assert text.count("<script>") == 1


def test_same_run_gives_the_same_page(tmp_path: Path, truth_file: Path) -> None:
    runs = {"with": write_slam_run(tmp_path / "b", 0.01, worst=(1,))}
    for name in ("one.html", "two.html"):
        write_report(tmp_path / name, "Demo", truth_file, runs)
    assert (tmp_path / "one.html").read_bytes() == (tmp_path / "two.html").read_bytes()


def test_run_that_tracked_nothing_has_facts_and_no_plot(tmp_path: Path, truth_file: Path) -> None:
    folder = write_slam_run(tmp_path / "lost", lost=range(3, 60))
    times = {"track": {"p50": 1.0, "p95": 2.0}}
    metrics = {"coverage": 0.0, "frames": 60, "tracked": 0, "ms": times}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    (folder / "trajectory.txt").write_text("# nothing\n")
    write_report(tmp_path / "report.html", "Lost", truth_file, {"lost": folder})
    page = open_page(tmp_path / "report.html")
    assert "Nothing was tracked: all 60 frames were lost." in page.text
    assert page.facts["Frames tracked"] == "0 of 60"
    assert "Trajectory" not in page.heads


def test_run_without_ground_truth_has_its_trajectory(tmp_path: Path) -> None:
    run = write_slam_run(tmp_path / "live")
    metrics = json.loads((run / "metrics.json").read_text())
    kept = {key: value for key, value in metrics.items() if not key.startswith(("ate", "rpe"))}
    (run / "metrics.json").write_text(json.dumps(kept))
    (run / "config.yaml").unlink()
    assert find_groundtruth(run) is None
    page = open_page(report([run], out=tmp_path / "page.html"))
    assert "Trajectory" in page.heads
    assert "Errors" not in page.heads
    assert "Without ground truth there are no errors." in page.text


def test_file_that_cannot_be_used_is_named(tmp_path: Path, truth_file: Path) -> None:
    folder = write_slam_run(tmp_path / "run")
    gone = tmp_path / "gone.jpg"
    with pytest.raises(DataError, match=r"gone\.jpg"):
        write_report(tmp_path / "r.html", "t", truth_file, {"run": folder}, [gone])
    for name in ("frames.csv", "config.yaml", "map.ply"):
        kept = (folder / name).read_bytes()
        (folder / name).write_bytes(b"a: [\n")
        with pytest.raises(DataError, match=name.replace(".", r"\.")):
            report([folder], groundtruth=truth_file)
        (folder / name).write_bytes(kept)
    assert not (folder / "report.html").exists()


@pytest.mark.parametrize(
    "metrics", ["{", "{}", "[]", '{"coverage": 1, "ms": [3]}', '{"coverage": 1, "ms": {"a": 3}}']
)
def test_metrics_of_another_kind_are_named(tmp_path: Path, metrics: str) -> None:
    run = write_slam_run(tmp_path / "run")
    (run / "metrics.json").write_text(metrics)
    with pytest.raises(DataError, match=r"metrics\.json: cannot be read as metrics"):
        report([run])


def test_map_shows_every_point_in_its_color_and_a_scale(tmp_path: Path) -> None:
    folder = write_slam_run(tmp_path / "run")
    points, colors = read_points(folder / "map.ply")
    assert points.shape == colors.shape == (400, 3)
    image = draw_map(read_slam_run("run", folder, None))
    assert image is not None
    assert max(image.shape) == pytest.approx(1100, abs=2)
    shown = set(map(tuple, image.reshape(-1, 3).tolist()))
    hidden = [color for color in colors[:, ::-1].tolist() if tuple(color) not in shown]
    assert len(hidden) < 40, "a few lie below others or below the path"


@pytest.mark.parametrize(("width", "length"), [(8.1, 2.0), (7.9, 1.0), (0.3, 0.05), (4.0, 1.0)])
def test_scale_bar_has_a_round_length(width: float, length: float) -> None:
    assert scale_length(width) == pytest.approx(length)


def test_time_counts_from_the_first_frame(tmp_path: Path) -> None:
    folder = write_slam_run(tmp_path / "run", lost=range(10))
    run = read_slam_run("run", folder, None)
    assert run.start == START
    assert run.frames is not None
    assert run.frames.lost_spans() == [(0, 9)]
