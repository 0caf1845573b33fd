"""Comparison of networks: train, score and time the rows, then write Table 4."""

import math
import os
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from cohdc_train.bench.networks import NetworkBenchOptions
from cohdc_train.bench.rows import ROWS, ScoredNetwork, row_config, score_model, train_row
from cohdc_train.bench.speed import Rate, frame_rates, make_runners, median_and_range, peak_memory
from cohdc_train.bench.table import RATES, TABLE_FILES, write_table
from cohdc_train.data.annotations import read_image
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.errors import CohdcError
from cohdc_train.files import claim_folder
from cohdc_train.types import Image, Row


def compare_networks(
    data: Path,
    out: Path,
    rows: Sequence[str] | None,
    models: Sequence[Path],
    options: NetworkBenchOptions,
) -> list[Row]:
    """Train, export, score and time networks, and write the table.

    Args:
        data: COCO-format folder.
        out: folder for all results.
        rows: names of ROWS and YAML files; None is all of ROWS.
        models: finished checkpoints and ONNX files.
        options: of the comparison.

    Returns:
        The rows of table4.json.

    Raises:
        CohdcError: a row is wrong, or a step failed.
    """
    rows_by_name = _check_rows(list(ROWS) if rows is None else rows, options)
    claim_folder(out, "bench", TABLE_FILES)
    seeds = options.seeds or [0]
    networks = _train_rows(rows_by_name, seeds, data, out, options)
    for model in models:
        print(model, flush=True)
        networks[str(model)] = [score_model(model, data, out, options)]

    split = CocoDataModule(data).folder.val
    images = [read_image(image) for image in split.images[: options.images]]
    first_seeds = {name: of_row[0] for name, of_row in networks.items()}
    rates = _measure_rates(first_seeds, images, options.threads)
    table = []
    for name, of_row in networks.items():
        peak_mb = peak_memory(of_row[0].files["fps_ort"], images[0], options.threads)
        table.append(make_row(name, of_row, rates[name], peak_mb))
    write_table(out, table, describe_environment(options.threads, data, len(images), seeds))
    return table


def _check_rows(rows: Sequence[str], options: NetworkBenchOptions) -> dict[str, str]:
    """Return the rows by name. Raises CohdcError for one that cannot be used."""
    weights = options.weights or {}
    for row in (*rows, *weights):
        row_config(row)
    if unused := set(weights) - set(rows):
        raise CohdcError(f"weights are given for {min(unused)!r}, which is none of the rows")
    by_name = {Path(row).stem: row for row in rows}
    if len(by_name) < len(rows):
        raise CohdcError(f"rows {', '.join(rows)}: two have the same name")
    return by_name


def _train_rows(
    rows: dict[str, str], seeds: Sequence[int], data: Path, out: Path, options: NetworkBenchOptions
) -> dict[str, list[ScoredNetwork]]:
    """Train all rows seed by seed, so that an interrupted run has every row at few seeds."""
    networks: dict[str, list[ScoredNetwork]] = {}
    for seed in seeds:
        for name, row in rows.items():
            print(f"{name}, seed {seed}", flush=True)
            network = train_row(row, seed, data, out / f"{name}_seed{seed}", options)
            networks.setdefault(name, []).append(network)
    return networks


def _measure_rates(
    networks: dict[str, ScoredNetwork], images: Sequence[Image], threads: int
) -> dict[str, dict[str, Rate]]:
    """Measure the rates of every row by column; all networks take turns."""
    runners = {}
    for name, network in networks.items():
        for column, runner in make_runners(network.checkpoint, network.files, threads).items():
            runners[name, column] = runner
    rates: dict[str, dict[str, Rate]] = {name: {} for name in networks}
    for (name, column), rate in frame_rates(runners, images).items():
        rates[name][column] = rate
    return rates


def make_row(
    name: str, networks: Sequence[ScoredNetwork], rates: dict[str, Rate], peak_mb: float
) -> Row:
    """Make a row of table4.json: medians and ranges over the seeds, None for a missing value.

    Args:
        name: name of the row.
        networks: its networks, one per seed.
        rates: images per second by column.
        peak_mb: peak memory, MiB.
    """
    first = networks[0]
    seconds = [n.train_seconds for n in networks if n.train_seconds is not None]
    sizes = {column: path.stat().st_size / 1e6 for column, path in first.files.items()}
    scores = {key: median_and_range([n.scores[key] for n in networks]) for key in first.scores}

    row: Row = {"name": name}
    row["train_seconds"] = median_and_range(seconds)[0] if seconds else None
    row |= {column: rates[column].median if column in rates else None for column in RATES}
    row |= {"model_mb": sizes["fps_ort"], "model_mb_int8": sizes.get("fps_ort_int8")}
    row |= {key: _none_if_nan(median) for key, (median, _, _) in scores.items()}
    row |= {"ap_int8": row.get("ap_int8"), "peak_mb": peak_mb}

    ranges = {
        key: [_none_if_nan(low), _none_if_nan(high)] for key, (_, low, high) in scores.items()
    }
    row["ranges"] = ranges | {column: [rate.low, rate.high] for column, rate in rates.items()}
    row["seeds"] = [network.seed for network in networks if network.seed is not None]
    return row


def _none_if_nan(value: float) -> float | None:
    return None if math.isnan(value) else value


def describe_environment(threads: int, data: Path, num_images: int, seeds: Sequence[int]) -> str:
    """Describe in one paragraph what the figures were measured on."""
    names = ("torch", "torchvision", "onnxruntime")
    parts = [
        f"{_cpu_name()}, {os.cpu_count()} CPUs",
        f"{threads} thread{'s' if threads > 1 else ''}",
        ", ".join(f"{name} {metadata.version(name)}" for name in names),
        f"{data.name}, {num_images} images timed in turn, seeds {', '.join(map(str, seeds))}",
    ]
    if hasattr(os, "getloadavg"):
        parts[0] += f", load {os.getloadavg()[0]:.1f} at the end"
    return "; ".join(parts)


def _cpu_name() -> str:
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.is_file():
        for line in cpu_info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
