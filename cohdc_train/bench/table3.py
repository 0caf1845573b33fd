"""`cohdc bench table3`: the paper's Table 3 at any scale, next to the published scores."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from cohdc_train.bench.published import TABLE3
from cohdc_train.errors import DataError
from cohdc_train.files import write_json, write_text
from cohdc_train.presets import config_path

_SCORES = {"mIoU": "mIoU", "mAP@.5": "segm_AP50", "mAP@.7": "segm_AP70"}
_LARGEST = {"train": 1014, "val": 180}  # images of the paper's largest tests


@dataclass(frozen=True)
class Table3Scale:
    """Size of the trainings of `cohdc bench table3`, relative to the paper's.

    Attributes:
        epochs_scale: factor of the epochs.
        size_scale: factor of the image sides, and of the anchors with them.
        weights: local file of ImageNet weights for the tests that are pretrained.
        options: further arguments of `cohdc fit`, such as '["--model.network.width=0.5"]'.
    """

    epochs_scale: float = 1.0
    size_scale: float = 1.0
    weights: str | None = None
    options: list[str] | None = None

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("epochs_scale", "size_scale"):
            if not getattr(self, name) > 0:
                raise DataError(f"{name} is {getattr(self, name):g}; it must be above 0")


def bench_table3(
    data: Path,
    *,
    out: Path,
    tests: list[int] | None = None,
    seeds: list[int] | None = None,
    jobs: int = 1,
    **scale: Any,
) -> list[dict[str, Any]]:
    """Train tests of the paper's Table 3 and write their scores next to the paper's.

    The image counts of the tests are scaled so that the largest, 1014 + 180, becomes all images of
    the folder. Finished trainings are not repeated. Writes table3.md and table3.json.

    Args:
        data: COCO-format folder.
        out: folder for all results.
        tests: numbers of the tests, 1 to 10; all when not given.
        seeds: seeds of the trainings of each test; [0, 1, 2] when not given.
        jobs: number of trainings at a time.
        **scale: fields of `Table3Scale`.

    Returns:
        The rows of table3.json.

    Raises:
        CohdcError: the folder, a test or an option is wrong, or a training failed.
    """
    from cohdc_train.bench.training import TrainingJob, format_mean, markdown_table, run_jobs

    settings = Table3Scale(**scale)
    tests, seeds = tests or list(TABLE3), seeds or [0, 1, 2]
    for test in tests:
        if test not in TABLE3:
            raise DataError(f"no test {test} in Table 3; there are 1 to {len(TABLE3)}")
    num_images = count_images(data)
    jobs_by_run = {
        (test, seed): TrainingJob(
            out / f"test{test:02}_seed{seed}",
            (data.resolve(),),
            (*fit_arguments(test, settings, num_images), f"--seed_everything={seed}"),
        )
        for seed in seeds
        for test in tests
    }
    scores = dict(zip(jobs_by_run, run_jobs(list(jobs_by_run.values()), jobs), strict=True))

    rows: list[dict[str, Any]] = []
    lines = []
    for test in tests:
        of_test = [scores[test, seed]["plain"] for seed in seeds]
        rows += [{"test": test, "seed": s, **r} for s, r in zip(seeds, of_test, strict=True)]
        measured = [format_mean([row[key] for row in of_test]) for key in _SCORES.values()]
        lines.append([f"Test {test}", *measured, *(f"{value:.3f}" for value in TABLE3[test])])
    head = ["", *(f"measured {name}" for name in _SCORES), *(f"paper {name}" for name in _SCORES)]
    text = markdown_table(head, lines)
    write_text(out / "table3.md", text)
    write_json(out / "table3.json", rows)
    print(text)
    return rows


def count_images(data: Path) -> dict[str, int]:
    """Count the images of a folder's train and val split."""
    from cohdc_train.data.layout import find_split, read_json

    return {
        split: len(read_json(find_split(data, split).annotations)["images"]) for split in _LARGEST
    }


def fit_arguments(test: int, scale: Table3Scale, num_images: dict[str, int]) -> tuple[str, ...]:
    """Build the arguments of `cohdc fit` for one test.

    Args:
        test: number of the test.
        scale: how large the training is.
        num_images: images of the folder, by split.
    """
    name = f"table3/test{test:02}.yaml"
    config = yaml.safe_load(config_path(name).read_text(encoding="utf-8"))
    network = config["model"]["network"]

    canvas = [round(side * scale.size_scale) for side in config["data"]["canvas"]]
    anchors = [max(1, round(side * scale.size_scale)) for side in network["anchor_scales"]]
    epochs = max(1, round(config["trainer"]["max_epochs"] * scale.epochs_scale))
    subset = {
        split: max(1, round(count * num_images[split] / _LARGEST[split]))
        for split, count in config["data"]["subset"].items()
    }
    arguments = [
        f"--config={name}",
        f"--data.canvas={canvas}",
        f"--data.subset={json.dumps(subset)}",
        f"--model.network.anchor_scales={anchors}",
        f"--trainer.max_epochs={epochs}",
    ]
    if "weights" in network and scale.weights is not None:
        arguments.append(f"--model.network.weights={scale.weights}")
    return (*arguments, *(scale.options or ()))
