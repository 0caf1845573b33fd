"""Pictures of validations: drawn from toy detections, by a tiny training, and by `cohdc validate`."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "data"))
import coco_toys
from test_train_cli import TINY
from test_train_matching import LEFT, LOWER, RIGHT, results_of, two
from test_train_metrics import SIZE, calibration, random_problem, square, truth_of

from cohdc_train.cli import main
from cohdc_train.data.annotations import CocoImage
from cohdc_train.files import MANIFEST
from cohdc_train.metrics.coco_metrics import IOUS, Results, precision_table
from cohdc_train.train import validation_figures as pictures
from cohdc_train.train.cli import FitCommand, fit
from cohdc_train.train.validation_figures import ValidationPictures, draw_validation
from cohdc_train.train.validation_plots import (
    class_names,
    plot_calibration,
    plot_confusion,
    plot_log,
    plot_precision_recall,
)

SHORT = ("--trainer.limit_train_batches=1", "--trainer.limit_val_batches=1")
VALIDATION = {"best.jpg", "worst.jpg", "pr_curves.png", "calibration.png", "confusion.png"}


def seen(content: bytes) -> Any:
    """The picture, decoded; it must be of a sensible size and show something."""
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


def test_precision_is_cocos_at_both_ious() -> None:
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
def test_a_validation_is_drawn_whatever_it_found(
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


def test_missed_and_false_are_red_and_found_is_not(tmp_path: Path) -> None:
    def reds(boxes: list[list[float]]) -> int:
        results = results_of(two(), boxes, [0.9] * len(boxes))
        b, g, r = (
            channel.astype(int)
            for channel in cv2.split(seen(draw_validation(results, [grey])["best.jpg"]))
        )
        return int(((r > b + 60) & (r > g + 60)).sum())

    grey = photograph(tmp_path, 7)
    cv2.imwrite(str(grey.path), np.full((*SIZE, 3), 100, np.uint8))
    assert reds([LEFT, RIGHT]) == 0
    assert reds([LEFT]) > 1000
    assert reds([LEFT, RIGHT, [10.0, 38.0, 30.0, 58.0]]) > 1000


def test_the_calibrations_title_tells_the_scores(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_a_log_with_gaps_nan_and_zeros_is_drawn(tmp_path: Path) -> None:
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
                "--pictures=true",
                *more,
            ]
        )
        return out

    return train


def test_a_fit_and_a_validation_leave_their_pictures(
    toy: Path, trained: Callable[..., Path]
) -> None:
    run = trained("run")
    folders = {
        run / "pictures": {*VALIDATION, "losses.png", "last"},
        run / "pictures" / "last": VALIDATION,
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
        (["--pictures=true"], True),
        (["--pictures=true", "--pictures=false"], False),
        (["--pictures=true", "--config=off.yaml"], False),
        (["--pictures=true", "--trainer.fast_dev_run=true"], False),
    ],
)
def test_pictures_are_drawn_unless_switched_off(
    toy: Path, more: list[str], drawn: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(toy)
    monkeypatch.setattr(FitCommand, "run", lambda self: None)
    Path("off.yaml").write_text("pictures: false\n")
    trainer = fit(["--config", "tiny.yaml", f"--data.root={toy}", f"--out={toy / 'off'}", *more])
    hooks = [hook for hook in trainer.callbacks if isinstance(hook, ValidationPictures)]  # type: ignore[attr-defined]
    assert [hook.folder for hook in hooks] == [toy / "off" / "pictures"] * drawn


def test_the_best_validations_pictures_stay_and_the_last_ones_are_beside_them(
    trained: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[int] = []

    def draw(*_: object) -> dict[str, bytes]:
        drawn.append(len(drawn))
        return {"picture.txt": str(drawn[-1]).encode()}

    monkeypatch.setattr(pictures, "draw_validation", draw)
    # at this rate no epoch scores better than the first; Lightning's trial validation is not drawn
    folder = (
        trained("standstill", "--trainer.max_epochs=2", "--model.optimizer.lr=1e-12", *SHORT)
        / "pictures"
    )
    assert [(folder / name).read_text() for name in ("picture.txt", "last/picture.txt")] == [
        "0",
        "1",
    ]


def test_what_cannot_be_drawn_is_told_and_the_training_goes_on(
    trained: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no ink")

    monkeypatch.setattr(pictures, "draw_validation", fail)
    with pytest.warns(UserWarning, match=r"(?s)the training goes on.*Traceback.*no ink"):
        run = trained("inkless", *SHORT)
    assert torch.load(run / "last.ckpt", weights_only=True)["global_step"] == 1


def test_other_processes_and_trials_draw_nothing(tmp_path: Path) -> None:
    hook = ValidationPictures(tmp_path)
    for first, trial in ((False, False), (True, True)):
        trainer: Any = SimpleNamespace(is_global_zero=first, sanity_checking=trial)
        hook.on_validation_end(trainer, None)  # type: ignore[arg-type]
    hook.on_train_end(SimpleNamespace(is_global_zero=False), None)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []
