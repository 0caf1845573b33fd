"""Closing lines of a training: scores, hints where something is off, files, the next command."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cohdc_train.data.annotations import CocoImage
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.models import NetworkConfig
from cohdc_train.train.checkpoints import BEST, LAST
from cohdc_train.train.initial_weights import FEW_IMAGES
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.progress import ProgressReporter

LOW_AP50 = 0.05
MANY_SMALL = 0.3  # share of objects below the anchors from which the canvas is too small
_SMALL_BATCH = 8  # images below which BatchNorm's statistics are noise
_FILES = (BEST, LAST, "config.yaml", "figures", "logs")
_PARTS = 5  # the first and the last fifth of the losses are compared
_MIN_PART = 10  # steps of a fifth from which they are
_CLEAR_FALL = 0.98  # of the loss in the first fifth


@dataclass(frozen=True)
class TrainingFacts:
    """Facts of a finished training that its closing lines tell.

    Attributes:
        scores: of the best validation, by name; empty without one.
        class_counts: validation objects by class name.
        losses: total loss of every step.
        network: of the training.
        batch_size: images per batch and device.
        random_weights: whether training started from random weights.
        images: training images.
        canvas: (height, width), px.
    """

    scores: Mapping[str, float]
    class_counts: Mapping[str, int]
    losses: Sequence[float]
    network: NetworkConfig
    batch_size: int
    random_weights: bool
    images: Sequence[CocoImage]
    canvas: tuple[int, int]

    def small_ratio(self) -> float:
        """Return the share of training objects below half the smallest anchor on the canvas."""
        limit = min(self.network.anchor_scales) / 2
        sides = [side for image in self.images for side in _sides_on_canvas(image, self.canvas)]
        return sum(side < limit for side in sides) / max(1, len(sides))


def training_facts(
    module: MaskRCNNModule, data: CocoDataModule, reporter: ProgressReporter, random_weights: bool
) -> TrainingFacts:
    """Collect the facts of a finished training; the scores are of its best validation."""
    best = max(
        reporter.history,
        key=lambda scores: (not math.isnan(scores["segm_AP"]), scores["segm_AP"]),
        default={},
    )
    counts = Counter(
        o.label for image in data.folder.val.images for o in image.objects if not o.crowd
    )
    images = [image for split in data.folder.train for image in split.images]
    return TrainingFacts(
        scores=best,
        class_counts={name: counts[i] for i, name in enumerate(data.class_names, 1)},
        losses=reporter.losses,
        network=module.network_config,
        batch_size=int(data.batch_size),
        random_weights=random_weights,
        images=images,
        canvas=data.canvas,
    )


def summary_lines(
    facts: TrainingFacts, out: Path, timing: str = "", best_ap: float | None = None
) -> list[str]:
    """Return the last lines of a training.

    Args:
        facts: of the training.
        out: its folder.
        timing: a line on times.
        best_ap: mask AP of best.ckpt, which may be of an earlier session.
    """
    lines = _score_lines(facts, best_ap) if facts.scores else []
    lines += [f"hint: {hint}" for hint in hints(facts)]
    if timing:
        lines.append(timing)
    files = [name for name in _FILES if (out / name).exists()]
    if files:
        lines.append(f"files in {out}: {', '.join(files)}")
    if BEST in files:
        images = facts.images[0].path.parent
        lines.append(f"next: cohdc export {out / BEST} --images {images}")
    return lines


def hints(facts: TrainingFacts) -> list[str]:
    """Return a sentence for each thing that is off, with what to do; none for a good training."""
    score_hints = [_low_score_hint(facts), _class_hint(facts)] if facts.scores else []
    other_hints = [_loss_hint(facts.losses), _anchor_hint(facts), _norm_hint(facts)]
    return [hint for hint in (*score_hints, *other_hints) if hint]


def _score_lines(facts: TrainingFacts, best_ap: float | None) -> list[str]:
    """Return a line on best.ckpt, and one on the classes where there are several."""
    ap, ap50 = facts.scores["segm_AP"], facts.scores["segm_AP50"]
    lines = [f"{BEST}: mask AP {ap:.3f}, AP50 {ap50:.3f} on the validation split"]
    if best_ap is not None and best_ap > ap + 1e-6:
        lines = [f"{BEST}: mask AP {best_ap:.3f}, of an earlier session; this one reached {ap:.3f}"]
    per_class = [
        f"{name} {facts.scores[f'segm_AP/{name}']:.3f}"
        for name in facts.class_counts
        if f"segm_AP/{name}" in facts.scores
    ]
    if per_class:
        lines.append(f"mask AP per class: {', '.join(per_class)}")
    return lines


def _sides_on_canvas(image: CocoImage, canvas: tuple[int, int]) -> list[float]:
    """Return the square roots of the objects' box areas on the canvas, px."""
    scale = min(canvas[0] / image.height, canvas[1] / image.width)
    return [scale * math.sqrt(o.box[2] * o.box[3]) for o in image.objects if not o.crowd]


def _low_score_hint(facts: TrainingFacts) -> str:
    ap50 = facts.scores["segm_AP50"]
    if not ap50 < LOW_AP50:
        return ""
    steps = f"AP50 is {ap50:.3f} after {len(facts.losses)} steps"
    if facts.random_weights and len(facts.images) < FEW_IMAGES:
        return (
            f"{steps} from random weights on {len(facts.images)} images: "
            "start from trained ones (--pretrained auto)"
        )
    return (
        f"{steps}: train longer (--minutes, --epochs), look at figures/worst.jpg, and check the "
        "labels with cohdc data doctor and cohdc fit --overfit 8"
    )


def _class_hint(facts: TrainingFacts) -> str:
    if facts.scores["segm_AP50"] < LOW_AP50:
        return ""
    missed = [
        f"{name} ({count} objects)"
        for name, count in facts.class_counts.items()
        if count and facts.scores.get(f"segm_AP/{name}", 1.0) == 0.0
    ]
    return f"never detected: {', '.join(missed)}; they need more training images" if missed else ""


def _loss_hint(losses: Sequence[float]) -> str:
    part = len(losses) // _PARTS
    if part < _MIN_PART:
        return ""
    first, last = float(np.mean(losses[:part])), float(np.mean(losses[-part:]))
    if last < _CLEAR_FALL * first:
        return ""
    return (
        f"the loss did not fall: {first:.3f} in the first fifth of the steps, {last:.3f} in the "
        "last: try another rate (cohdc fit --lr_find true, --model.optimizer.lr)"
    )


def _anchor_hint(facts: TrainingFacts) -> str:
    ratio = facts.small_ratio()
    if ratio < MANY_SMALL:
        return ""
    limit = min(facts.network.anchor_scales) // 2
    return (
        f"{ratio:.0%} of the objects are smaller than {limit} px on the canvas, half the smallest "
        "anchor: a larger --data.canvas sees them"
    )


def _norm_hint(facts: TrainingFacts) -> str:
    if facts.network.norm != "batch" or facts.batch_size >= _SMALL_BATCH:
        return ""
    return (
        f"BatchNorm was trained on batches of {facts.batch_size}, and its statistics are noise "
        f"below {_SMALL_BATCH} images: raise --data.batch_size, or start from trained weights with "
        "frozen norms (--pretrained auto)"
    )
