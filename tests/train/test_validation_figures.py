"""Figures of validations: of toy detections, of a tiny training, and of `cohdc validate`."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import coco_toys
import cv2
import numpy as np
import pytest
import torch
from test_coco_metrics import SIZE, calibration, random_problem, square, truth_of
from test_fit import TINY
from test_image_matching import LEFT, LOWER, RIGHT, results_of, two

from cohdc_train.cli import main
from cohdc_train.data.annotations import CocoImage
from cohdc_train.files import MANIFEST
from cohdc_train.metrics.average_precision import IOUS, precision_table
from cohdc_train.metrics.coco_metrics import Results
from cohdc_train.train import validation_figures as figures
from cohdc_train.train.cli import FitCommand, fit
from cohdc_train.train.training_plots import plot_log
from cohdc_train.train.validation_figures import ValidationFigures, draw_validation
from cohdc_train.train.validation_plots import (
    class_names,
    plot_calibration,
    plot_confusion,
    plot_precision_recall,
)

SHORT = ("--trainer.limit_train_batches=1", "--trainer.limit_val_batches=1")
VALIDATION = {"best.jpg", "worst.jpg", "pr_curves.png", "calibration.png", "confusion.png"}


def seen(content: bytes) -> Any:
    """Decode a figure; it must be of a sensible size and show something."""
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    assert min(image.shape[:2]) >= 300
    assert max(image.shape[:2]) <= 4000
    assert image.std() > 5
    return image


def photograph(folder: Path, image_id: int, size: tuple[int, int] = SIZE) -> CocoImage:
    path = folder / f"{image_id}.png"
    cv2.imwrite(
        str(path), np.random.default_rng(image_id).integers(0, 255, (*size, 3), dtype=np.uint8)
    )
    return CocoImage(image_id, path, *size, ())


def test_precision_curves_equal_coco() -> None:
    boxes = [
        LEFT,
        [10.0, 38.0, 30.0, 58.0],
        [50.0, 14.0, 70.0, 34.0],
    ]  # right, false, right with IoU 2/3
    precision = results_of(two(), boxes, [0.9, 0.8, 0.7]).precision
    assert precision.shape == (10, 101, 3)
    at = {iou: precision[int(np.argmin(np.abs(IOUS - iou))), :, 0] for iou in (0.5, 0.75)}
    assert at[0.5] == pytest.approx([1.0] * 51 + [2 / 3] * 50)
    assert at[0.75] == pytest.approx([1.0] * 51 + [0.0] * 50)
    assert (precision[:, :, 1:] == -1).all(), "classes without objects"


@pytest.mark.parametrize(
    ("truth", "boxes", "quality"),
    [
        (two(second=2), [LEFT, LOWER, RIGHT], [0.9, 0.5, 0.7]),
        (two(), [LEFT, RIGHT, LOWER], [1.0, 1.0, 1.0]),  # without a CQE head
        (two(), [], []),
        (truth_of(square(10, 10, 20), crowd=True), [LEFT, RIGHT], [0.5, 0.6]),
        (truth_of(), [], []),
        (truth_of(), [LEFT], [0.3]),
    ],
    ids=[
        "two classes of three",
        "no quality",
        "no detections",
        "crowd only",
        "nothing at all",
        "false only",
    ],
)
def test_validation_with_any_detections_is_drawn(
    truth: Any, boxes: Any, quality: Any, tmp_path: Path
) -> None:
    results = results_of(
        truth, boxes, [0.9] * len(boxes), [k % 3 for k in range(len(boxes))], quality
    )
    files = draw_validation(results, [photograph(tmp_path, 7)])
    assert set(files) == VALIDATION
    empty = not boxes and not any(not row["iscrowd"] for row in truth["annotations"])
    for name, content in files.items():
        if name.endswith(".png") or not empty:
            seen(content)


def test_images_of_different_sizes_share_a_grid(tmp_path: Path) -> None:
    truth = two()
    truth["images"] += [
        {"id": 8, "height": 300, "width": 20},
        {"id": 9, "height": 700, "width": 1300},
    ]
    box = {"iscrowd": 0, "category_id": 1, "area": 100.0, "bbox": [2, 2, 10, 10]}
    shape = [[2, 2, 12, 2, 12, 12, 2, 12]]
    truth["annotations"] += [
        {**box, "id": 10 + i, "image_id": i, "segmentation": shape} for i in (8, 9)
    ]
    results = results_of(truth, [LEFT], [0.9])
    more = Results(
        {**results.truth, "images": truth["images"], "annotations": truth["annotations"]},
        *rest(results),
    )
    images = [
        photograph(tmp_path, 7),
        photograph(tmp_path, 8, (300, 20)),
        photograph(tmp_path, 9, (700, 1300)),
    ]
    grids = [seen(draw_validation(more, images)[name]) for name in ("best.jpg", "worst.jpg")]
    assert grids[0].shape == grids[1].shape


def rest(results: Results) -> tuple[Any, ...]:
    return results.rows, results.kept, results.precision, results.scores


def test_missed_and_false_are_red(tmp_path: Path) -> None:
    def reds(boxes: list[list[float]]) -> int:
        results = results_of(two(), boxes, [0.9] * len(boxes))
        b, g, r = (
            channel.astype(int)
            for channel in cv2.split(seen(draw_validation(results, [gray])["best.jpg"]))
        )
        return int(((r > b + 60) & (r > g + 60)).sum())

    gray = photograph(tmp_path, 7)
    cv2.imwrite(str(gray.path), np.full((*SIZE, 3), 100, np.uint8))
    assert reds([LEFT, RIGHT]) == 0
    assert reds([LEFT]) > 1000
    assert reds([LEFT, RIGHT, [10.0, 38.0, 30.0, 58.0]]) > 1000


def test_title_of_calibration_has_the_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.axes import Axes

    titles: list[str] = []
    monkeypatch.setattr(Axes, "set_title", lambda self, text, **_: titles.append(text))
    results = results_of(
        two(), [LEFT, LOWER, RIGHT, RIGHT], [0.9] * 4, quality=[0.95, 0.5, 0.8, 0.9]
    )
    plot_calibration(results)
    scores = calibration(results.truth, results.rows)
    spearman, error = scores["quality_spearman"], scores["quality_error"]
    assert titles == [
        f"4 detections of class score ≥ 0.5\nSpearman {spearman:.3f}, mean error {error:.3f}"
    ]


@pytest.mark.parametrize("classes", [1, 9, 80])
def test_many_classes_with_odd_names_are_drawn(classes: int) -> None:
    truth, rows = random_problem(0)
    odd = ["_hidden", "a$b$c", "ein sehr langer Name eines Gegenstands"]
    truth["categories"] = [
        {"id": i + 1, "name": odd[i] if i < 3 else f"c{i}"} for i in range(classes)
    ]
    for row in [*truth["annotations"], *rows]:
        row["category_id"] = 1 + row["image_id"] * 7 % classes
    precision = precision_table(truth, rows, "segm")
    seen(plot_precision_recall(Results(truth, [], [], precision, {})))
    counts = np.random.default_rng(0).integers(0, 30, (classes + 1, classes + 1))
    seen(plot_confusion(counts, class_names(truth)))


def test_log_with_gaps_nan_and_zeros_is_drawn(tmp_path: Path) -> None:
    log = tmp_path / "metrics.csv"
    log.write_text(
        "epoch,lr-AdamW,step,train/loss,train/mask,val/mIoU,val/segm_AP,val/segm_AP/car\n"
        ",0.1,0,,,,,\n0,,1,2.5,0.0,,,\n0,,3,1.5,0.5,,,\n0,,3,,,nan,0.1,0.2\n1,,5,1.0,0.0,,,\n1,,7,,,0.5,0.3,0.4\n"
    )
    seen(plot_log(log))
    log.write_text("epoch,step\n")
    seen(plot_log(log))


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = coco_toys.folder(tmp_path_factory.mktemp("toy"))
    (root / "tiny.yaml").write_text(TINY, encoding="utf-8")
    return root


@pytest.fixture(scope="module")
def trained(toy: Path) -> Callable[..., Path]:
    def train(name: str, *more: str) -> Path:
        out = toy / name
        fit(
            [
                "--config",
                str(toy / "tiny.yaml"),
                f"--data.root={toy}",
                f"--out={out}",
                "--figures=true",
                *more,
            ]
        )
        return out

    return train


def test_fit_and_validate_write_their_figures(toy: Path, trained: Callable[..., Path]) -> None:
    run = trained("run")
    folders = {
        run / "figures": {*VALIDATION, "losses.png", "last"},
        run / "figures" / "last": VALIDATION,
    }
    assert (
        main(
            [
                "validate",
                str(run / "best.ckpt"),
                str(toy),
                "--workers=0",
                f"--figures={toy / 'new' / 'p'}",
            ]
        )
        == 0
    )
    folders[toy / "new" / "p"] = VALIDATION
    for folder, names in folders.items():
        assert {path.name for path in folder.iterdir()} - {MANIFEST} == names
        for name in names - {"last"}:
            seen((folder / name).read_bytes())


@pytest.mark.parametrize(
    ("more", "drawn"),
    [
        (["--figures=true"], True),
        (["--figures=true", "--figures=false"], False),
        (["--figures=true", "--config=off.yaml"], False),
        (["--figures=true", "--trainer.fast_dev_run=true"], False),
    ],
)
def test_figures_are_drawn_unless_switched_off(
    toy: Path, more: list[str], drawn: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(toy)
    monkeypatch.setattr(FitCommand, "run", lambda self: None)
    Path("off.yaml").write_text("figures: false\n")
    trainer = fit(["--config", "tiny.yaml", f"--data.root={toy}", f"--out={toy / 'off'}", *more])
    hooks = [hook for hook in trainer.callbacks if isinstance(hook, ValidationFigures)]  # type: ignore[attr-defined]
    assert [hook.folder for hook in hooks] == [toy / "off" / "figures"] * drawn


def test_figures_of_best_and_last_validation_are_kept(
    trained: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []

    def draw(*_: object) -> dict[str, bytes]:
        drawn.append(len(drawn))
        return {"figure.txt": str(drawn[-1]).encode()}

    monkeypatch.setattr(figures, "draw_validation", draw)
    # at this rate no epoch scores better than the first; Lightning's trial validation is not drawn
    folder = (
        trained("standstill", "--trainer.max_epochs=2", "--model.optimizer.lr=1e-12", *SHORT)
        / "figures"
    )
    assert [(folder / name).read_text() for name in ("figure.txt", "last/figure.txt")] == [
        "0",
        "1",
    ]


def test_failed_figure_warns_and_training_continues(
    trained: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no ink")

    monkeypatch.setattr(figures, "draw_validation", fail)
    with pytest.warns(UserWarning, match=r"(?s)the training continues.*Traceback.*no ink"):
        run = trained("inkless", *SHORT)
    assert torch.load(run / "last.ckpt", weights_only=True)["global_step"] == 1


def test_other_processes_and_trials_draw_nothing(tmp_path: Path) -> None:
    hook = ValidationFigures(tmp_path)
    for first, trial in ((False, False), (True, True)):
        trainer: Any = SimpleNamespace(is_global_zero=first, sanity_checking=trial)
        hook.on_validation_end(trainer, None)  # type: ignore[arg-type]
    hook.on_train_end(SimpleNamespace(is_global_zero=False), None)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []
