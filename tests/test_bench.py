"""`cohdc bench networks`: rows are cached, timed in turn, and written; a tiny bench runs."""

import csv
import json
from pathlib import Path

import coco_toys
import numpy as np
import pytest
import yaml

from cohdc_train.bench import rows as rows_module
from cohdc_train.bench.comparison import make_row
from cohdc_train.bench.networks import NetworkBenchOptions, bench_networks
from cohdc_train.bench.rows import ROWS, ScoredNetwork, row_config
from cohdc_train.bench.speed import Rate, frame_rates, median_and_range, peak_memory
from cohdc_train.bench.table import format_table, plot_table
from cohdc_train.bench.training import run_command, train
from cohdc_train.errors import CohdcError
from cohdc_train.segmenter import Detections

KEYS = {
    *(
        "name",
        "train_seconds",
        "fps_torch",
        "fps_ort",
        "fps_ort_int8",
        "model_mb",
        "ap",
        "boundary_ap",
    ),
    *("s90_matched", "s90_all", "peak_mb"),
}
TINY = """
data: {canvas: [48, 64]}
model:
  network:
    {width: 0.125, fpn_channels: 8, fc: 16, anchor_scales: [8, 16, 32, 64], rois: 16,
     proposals: [50, 20], detections: 10}
trainer: {accelerator: cpu, enable_model_summary: false}
"""


def nothing(rgb):
    empty = np.zeros((0, 4), np.float32)
    fields = (
        np.zeros(0, np.int64),
        np.zeros(0, np.float32),
        np.zeros(0, np.float32),
        np.zeros((0, 28, 28), np.float32),
    )
    return Detections(empty, *fields, rgb.shape[:2], ("person",))


def test_runners_take_turns_and_the_warmup_is_not_measured(monkeypatch):
    clock = [0.0]
    order = []

    def runner(name, seconds):
        def run(rgb):
            order.append((name, int(rgb[0, 0, 0])))
            clock[0] += seconds * (100 if len(order) <= 2 else 1)
            return nothing(rgb)

        return run

    monkeypatch.setattr(
        "cohdc_train.exporter.interleaved_timing.time.perf_counter", lambda: clock[0]
    )
    images = [np.full((8, 8, 3), i, np.uint8) for i in range(3)]
    rates = frame_rates({"slow": runner("slow", 0.5), "fast": runner("fast", 0.125)}, images)
    assert order == [(name, i) for i in (0, 0, 1, 2) for name in ("slow", "fast")]
    assert rates["slow"] == pytest.approx((2, 2, 2))
    assert rates["fast"] == pytest.approx((8, 8, 8))


def entry(tmp_path: Path, seed: int | None, ap: float) -> ScoredNetwork:
    files = {"fps_ort": tmp_path / "a.onnx"} | (
        {} if seed is None else {"fps_ort_int8": tmp_path / "b.onnx"}
    )
    for path in files.values():
        path.write_bytes(b"0" * 2_500_000)
    scores = {
        "ap": ap,
        "boundary_ap": 0.1,
        "s90_matched": float("nan"),
        "s90_all": 0.0,
        "vertices": 20.0,
    }
    seconds = None if seed is None else 60.0 + 10 * seed
    return ScoredNetwork(
        "row",
        seed,
        None,
        files,
        seconds,
        scores if seed is None else scores | {"ap_int8": ap - 0.01},
    )


def test_row_holds_medians_ranges_and_none_for_missing_values(tmp_path):
    rates = {"fps_ort": (4.0, 3.0, 5.0), "fps_ort_int8": (8.0, 7.0, 9.0)}
    row = make_row(
        "ours",
        [entry(tmp_path, s, ap) for s, ap in enumerate((0.3, 0.5, 0.4))],
        _rates(rates),
        99.0,
    )
    assert set(row) >= KEYS
    assert (row["ap"], row["ap_int8"], row["train_seconds"]) == pytest.approx((0.4, 0.39, 70.0))
    assert row["ranges"]["ap"] == [0.3, 0.5]
    assert row["s90_matched"] is None
    assert row["fps_torch"] is None
    assert row["model_mb"] == 2.5
    foreign = make_row(
        "peer.onnx", [entry(tmp_path, None, 0.2)], _rates({"fps_ort": (4.0, 3.0, 5.0)}), 99.0
    )
    assert foreign["train_seconds"] is foreign["fps_ort_int8"] is foreign["ap_int8"] is None
    text = format_table([row, foreign], "a machine")
    assert "0.400 (0.300-0.500)" in text
    assert "4.00 (3.00-5.00)" in text
    assert text.splitlines()[3].startswith("| peer.onnx | - | - | 4.00")
    assert text.endswith("a machine\n")
    assert plot_table([row, foreign]).startswith(b"\x89PNG")


def _rates(values):
    return {name: Rate(*rate) for name, rate in values.items()}


def test_median_and_range():
    assert median_and_range([3.0, 1.0, 10.0]) == (3.0, 1.0, 10.0)


def test_budget_is_epochs_or_minutes():
    by_epochs = NetworkBenchOptions(fit_config=Path("c.yaml"), options=["--x=1"], epochs=3)
    assert by_epochs.fit_arguments() == ("--config=c.yaml", "--x=1", "--trainer.max_epochs=3")
    by_time = NetworkBenchOptions(train_minutes=90.5)
    assert by_time.fit_arguments() == (
        "--trainer.max_time=00:01:30:30",
        "--trainer.max_epochs=-1",
    )
    for epochs, minutes, given in ((None, None, "neither"), (3, 2.0, "both")):
        options = NetworkBenchOptions(epochs=epochs, train_minutes=minutes)
        with pytest.raises(CohdcError, match=f"give --epochs or --train-minutes, not {given}"):
            options.fit_arguments()
    with pytest.raises(CohdcError, match="threads is 0 and images is 20; both are at least 1"):
        NetworkBenchOptions(threads=0)


def test_failed_memory_probe_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(CohdcError, match=r"no\.onnx: does not run by itself: .*no such file"):
        peak_memory(tmp_path / "no.onnx", np.zeros((8, 8, 3), np.uint8), 1)
    assert list(tmp_path.iterdir()) == []


def _renamed(folder, name):
    (folder / name).write_text(row_config("ResNet50").read_text())
    return str(folder / name)


def test_bench_keeps_a_table_it_did_not_write(tmp_path):
    (tmp_path / "table4.csv").write_text("mine")
    with pytest.raises(CohdcError, match=r"holds table4\.csv, not written by a former cohdc bench"):
        bench_networks(tmp_path, out=tmp_path, rows=[], models=[tmp_path / "absent.onnx"], epochs=1)
    assert (tmp_path / "table4.csv").read_text() == "mine"


def test_unknown_rows_and_files_are_one_line(tmp_path):
    with pytest.raises(
        CohdcError, match="no row 'VGG'; there are HDC-Net, ResNet50, ResNet101, MobileNetV1"
    ):
        bench_networks(tmp_path, out=tmp_path / "o", rows=["VGG"], epochs=1)
    with pytest.raises(CohdcError, match="two have the same name"):
        bench_networks(
            tmp_path,
            out=tmp_path / "o",
            rows=["ResNet50", _renamed(tmp_path, "ResNet50.yaml")],
            epochs=1,
        )
    with pytest.raises(
        CohdcError, match="weights are given for 'MobileNetV1', which is none of the rows"
    ):
        bench_networks(
            tmp_path,
            out=tmp_path / "o",
            rows=["ResNet50"],
            weights={"MobileNetV1": "x.pth"},
            epochs=1,
        )
    with pytest.raises(CohdcError, match="no row 'VGG'"):
        bench_networks(
            tmp_path, out=tmp_path / "o", rows=["ResNet50"], weights={"VGG": "x.pth"}, epochs=1
        )
    with pytest.raises(CohdcError, match=r"absent\.onnx: no such file"):
        bench_networks(
            tmp_path, out=tmp_path / "o", rows=[], models=[tmp_path / "absent.onnx"], epochs=1
        )


def test_training_repeats_only_when_its_options_change(tmp_path, monkeypatch):
    calls = []

    def fake(log, verb, *arguments, threads):
        calls.append(arguments)
        (tmp_path / "last.ckpt").write_bytes(b"weights")

    monkeypatch.setattr("cohdc_train.bench.training.run_command", fake)
    first = train(tmp_path, [Path("d")], ["--a=1"])
    assert train(tmp_path, [Path("d")], ["--a=1"]) == first
    assert len(calls) == 1
    train(tmp_path, [Path("d")], ["--a=2"])
    assert len(calls) == 2
    (tmp_path / "last.ckpt").unlink()
    train(tmp_path, [Path("d")], ["--a=2"])
    assert len(calls) == 3


@pytest.mark.slow
def test_failed_step_names_its_log(tmp_path):
    with pytest.raises(CohdcError, match=r"log\.txt: cohdc fit failed with"):
        run_command(tmp_path / "log.txt", "fit", "--no.such.option=1")
    assert "no.such.option" in (tmp_path / "log.txt").read_text()


def test_scores_are_reused_until_the_file_changes(tmp_path, monkeypatch):
    file = tmp_path / "model.onnx"
    file.write_bytes(b"one")
    runs = []

    class Scored:
        rows = ()
        scores = dict.fromkeys(rows_module.SCORES.values(), 0.25)

    monkeypatch.setattr(rows_module, "score_file", lambda *a, **k: runs.append(a) or Scored)
    cache_file = tmp_path / "scores.json"
    first = rows_module._score_once({"fps_ort": file}, tmp_path, cache_file, 1)
    assert first["ap"] == 0.25
    assert np.isnan(first["vertices"])
    rows_module._score_once({"fps_ort": file}, tmp_path, cache_file, 1)
    assert len(runs) == 1
    file.write_bytes(b"two")
    rows_module._score_once({"fps_ort": file}, tmp_path, cache_file, 1)
    assert len(runs) == 2


def network_of(row):
    from cohdc_train.models import MaskRCNN, NetworkConfig

    shape = yaml.safe_load(row_config(row).read_text())["model"]["network"]
    return MaskRCNN(1, NetworkConfig(**shape, canvas=(96, 128)))


def test_rows_differ_as_their_names_say():
    """Compare Table 4's networks by tensors and rates; HDC-Net is a tenth smaller than ResNet50."""
    networks = {row: network_of(row) for row in (*ROWS, "networks/resnet50_hdc.yaml")}
    body, whole = (
        {
            row: sum(p.numel() for p in part(network).parameters())
            for row, network in networks.items()
        }
        for part in (lambda network: network.backbone.body, lambda network: network)
    )
    for row, network in networks.items():
        dilated = any(rate > 1 for stage in network.backbone.body.rates() for rate in stage)
        assert dilated == (row in ("HDC-Net", "networks/resnet50_hdc.yaml"))
    assert body["MobileNetV1"] < body["ResNet50"] < body["ResNet101"]
    assert whole["networks/resnet50_hdc.yaml"] == whole["ResNet50"]
    assert whole["HDC-Net"] < 0.9 * whole["ResNet50"]


def test_the_family_shrinks_from_m_to_n():
    """Compare sizes: s has the layers of n, more pixels and more objects."""
    m, s, n = (network_of(f"networks/hdc_net_{size}.yaml") for size in "msn")
    sizes = [sum(p.numel() for p in network.parameters()) for network in (m, s, n)]
    assert sizes[0] > sizes[1] == sizes[2]
    assert sizes[-1] * 4 < 20e6  # bytes in float32; a fourth of it in int8
    assert s.config.proposals[1] > n.config.proposals[1]
    assert s.config.detections > n.config.detections


def test_training_repeats_when_its_configuration_changes(tmp_path, monkeypatch):
    calls = []

    def fake(log, verb, *arguments, threads):
        calls.append(arguments)
        (tmp_path / "last.ckpt").write_bytes(b"weights")

    monkeypatch.setattr("cohdc_train.bench.training.run_command", fake)
    config = tmp_path / "c.yaml"
    for text in ("a: 1", "a: 1", "a: 2"):
        config.write_text(text)
        train(tmp_path, [Path("d")], [f"--config={config}"])
    assert len(calls) == 2


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_tiny_bench_from_data_to_table(tmp_path, capsys):
    data = coco_toys.folder(tmp_path / "data")
    (tmp_path / "tiny.yaml").write_text(TINY)
    options = {
        "rows": ["networks/resnet50.yaml", "MobileNetV1"],
        "fit_config": tmp_path / "tiny.yaml",
        "epochs": 1,
        "images": 2,
    }
    table = bench_networks(data, out=tmp_path / "out", **options)
    written = json.loads((tmp_path / "out" / "table4.json").read_text())
    assert [row["name"] for row in written] == ["resnet50", "MobileNetV1"]
    for row in written:
        assert set(row) >= KEYS
        assert (
            min(
                row[key]
                for key in ("train_seconds", "fps_torch", "fps_ort", "fps_ort_int8", "peak_mb")
            )
            > 0
        )
        assert row["model_mb_int8"] < row["model_mb"]
        assert 0 <= row["ap"] <= 1
        assert row["peak_mb"] < 400  # of a process without torch, not of this one
    with (tmp_path / "out" / "table4.csv").open() as stream:
        assert [row["name"] for row in csv.DictReader(stream)] == [row["name"] for row in table]
    assert (tmp_path / "out" / "table4.png").read_bytes().startswith(b"\x89PNG")
    before = {path: path.stat().st_mtime for path in (tmp_path / "out").rglob("*.onnx")}
    ours = tmp_path / "out" / "resnet50_seed0" / "model.onnx"
    again = bench_networks(data, out=tmp_path / "out", models=[ours], **options)
    assert {path: path.stat().st_mtime for path in (tmp_path / "out").rglob("*.onnx")} == before
    assert again[2]["ap"] == again[0]["ap"]
    assert again[2]["fps_torch"] is None
