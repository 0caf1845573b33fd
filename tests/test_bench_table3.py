"""`cohdc bench table3`: tests are scaled as asked, trained once per seed, and put into a table."""

import json
from pathlib import Path
from typing import Any

import coco_toys
import pytest

from cohdc_train.bench import training
from cohdc_train.bench.table3 import Table3Scale, bench_table3, count_images, fit_arguments
from cohdc_train.bench.training import TrainingJob, TrainingRun
from cohdc_train.cli import main
from cohdc_train.errors import CohdcError, DataError


def values(arguments: tuple[str, ...]) -> dict[str, str]:
    """Split `--name=value` arguments."""
    return dict(argument.removeprefix("--").split("=", 1) for argument in arguments)


def test_scale_shrinks_image_anchors_epochs_and_subset() -> None:
    scale = Table3Scale(epochs_scale=0.05, size_scale=0.25, options=["--x=1"])
    given = values(fit_arguments(8, scale, {"train": 507, "val": 18}))
    assert given["config"] == "table3/test08.yaml"
    assert json.loads(given["data.canvas"]) == [270, 480]
    assert json.loads(given["model.network.anchor_scales"]) == [2, 4, 8, 16]
    assert given["trainer.max_epochs"] == "5"
    assert json.loads(given["data.subset"]) == {"train": 507, "val": 18}
    assert given["x"] == "1"
    smaller = values(fit_arguments(9, scale, {"train": 507, "val": 18}))
    assert json.loads(smaller["data.subset"]) == {"train": 240, "val": 12}


def test_local_weights_go_to_pretrained_tests_only() -> None:
    scale, num_images = Table3Scale(weights="w.pth"), {"train": 10, "val": 2}
    assert values(fit_arguments(10, scale, num_images))["model.network.weights"] == "w.pth"
    assert "model.network.weights" not in values(fit_arguments(9, scale, num_images))


def fake_run(job: TrainingJob) -> dict[str, dict[str, float]]:
    seed = int(job.folder.name[-1])
    return {"plain": {"mIoU": 0.1 * seed, "segm_AP50": 0.2, "segm_AP70": 0.3}}


def test_table_holds_measured_and_published_scores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TrainingJob, "run", fake_run)
    data = coco_toys.folder(tmp_path / "data")
    rows = bench_table3(data, out=tmp_path, tests=[1, 10], seeds=[1, 2])
    assert [(row["test"], row["seed"]) for row in rows] == [(1, 1), (1, 2), (10, 1), (10, 2)]
    assert json.loads((tmp_path / "table3.json").read_text()) == rows
    lines = (tmp_path / "table3.md").read_text().splitlines()
    assert lines[0].startswith("|  | measured mIoU | measured mAP@.5 ")
    assert lines[2].startswith("| Test 1 | 0.150 (0.100-0.200) | 0.200 (0.200-0.200) |")
    assert lines[2].endswith("| 0.485 | 0.569 | 0.472 |")


def test_images_are_counted_in_any_layout(tmp_path: Path) -> None:
    data = coco_toys.folder(tmp_path, train=5, val=2)
    (tmp_path / "annotations").mkdir()
    for split in ("train", "val"):
        file = tmp_path / f"instances_{split}.json"
        file.rename(tmp_path / "annotations" / f"instances_{split}2017.json")
    assert count_images(data) == {"train": 5, "val": 2}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--tests", "[11]"], "no test 11 in Table 3; there are 1 to 10"),
        (["--size_scale", "0"], "size_scale is 0; it must be above 0"),
        ([], "data: no such folder"),
    ],
)
def test_wrong_input_is_one_line(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = str(tmp_path / "data"), str(tmp_path / "out")
    assert main(["bench", "table3", data, "--out", out, *words]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(message)


def test_job_is_scored_once_and_again_with_other_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[tuple[Any, ...]] = []

    def fake_command(log: Path, name: str, *arguments: str) -> None:
        calls.append((name, *arguments))
        out = next(a.removeprefix("--out=") for a in arguments if a.startswith("--out="))
        Path(out).write_text('{"segm_AP50": 0.5}')

    checkpoint = tmp_path / "last.ckpt"
    monkeypatch.setattr(training, "train", lambda *_: TrainingRun(checkpoint, 7.0))
    monkeypatch.setattr(training, "run_command", fake_command)
    job = TrainingJob(tmp_path, (tmp_path / "data",), ("--a=1",))
    assert job.run() == job.run() == {"plain": {"segm_AP50": 0.5, "seconds": 7.0}}
    assert len(calls) == 1
    assert calls[0][:3] == ("validate", str(checkpoint), str(tmp_path / "data"))
    TrainingJob(tmp_path, (tmp_path / "data",), ("--a=2",)).run()
    assert len(calls) == 2


def test_failed_training_ends_the_table_with_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(job: TrainingJob) -> dict[str, dict[str, float]]:
        raise CohdcError("log.txt: cohdc fit failed")

    monkeypatch.setattr(TrainingJob, "run", fail)
    with pytest.raises(CohdcError, match=r"log\.txt: cohdc fit failed"):
        bench_table3(coco_toys.folder(tmp_path / "data"), out=tmp_path, tests=[1])
    with pytest.raises(DataError, match="no test 0"):
        bench_table3(tmp_path, out=tmp_path, tests=[0])
