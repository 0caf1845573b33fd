"""What the end of a training says: scores, files, the next command, and hints where something is
off.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cohdc_train.data.annotations import CocoImage
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.models import NetworkConfig
from cohdc_train.train.initial_weights import FEW_IMAGES
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.train.progress import ProgressReporter

LOW_AP50 = 0.05
MANY_SMALL = 0.3  # share of objects below the anchors from which the canvas is too small
_SMALL_BATCH = 8  # images below which BatchNorm's statistics are noise
_FILES = ("best.ckpt", "last.ckpt", "config.yaml", "pictures", "logs")
_PART = 5  # the first and the last fifth of the losses are compared


@dataclass(frozen=True)
class TrainingFacts:
    """What the hints are drawn from.

    Attributes:
        scores: of the last validation, by name.
        class_counts: class name -> validation objects.
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
        """Return the share of training objects that are smaller on the canvas than half the
        smallest anchor.
        """
        limit = min(self.network.anchor_scales) / 2
        sides = [side for image in self.images for side in _sides_on_canvas(image, self.canvas)]
        return sum(side < limit for side in sides) / max(1, len(sides))


def hints(facts: TrainingFacts) -> list[str]:
    """Return a sentence for each thing that is off, with what to do; none for a healthy training."""
    found = [
        _low_score_hint(facts),
        _loss_hint(facts.losses),
        _class_hint(facts),
        _anchor_hint(facts),
        _norm_hint(facts),
    ]
    return [hint for hint in found if hint]


def training_facts(
    module: MaskRCNNModule, data: CocoDataModule, reporter: ProgressReporter, random_weights: bool
) -> TrainingFacts:
    """Collect what the summary and its hints say of a finished training; its best validation is
    scored.
    """
    best = max(
        reporter.history, key=lambda scores: (not math.isnan(scores["segm_AP"]), scores["segm_AP"])
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


def summary_lines(facts: TrainingFacts, out: Path, best_ap: float | None = None) -> list[str]:
    """Return the last lines of a training.

    out: its folder; best_ap: mask AP of best.ckpt, which may be of an earlier session.
    """
    scores = facts.scores
    lines = [
        f"best.ckpt: mask AP {scores['segm_AP']:.3f}, AP50 {scores['segm_AP50']:.3f} on the validation split"
    ]
    per_class = [
        f"{name} {scores[f'segm_AP/{name}']:.3f}"
        for name in facts.class_counts
        if f"segm_AP/{name}" in scores
    ]
    if per_class:
        lines.append(f"mask AP per class: {', '.join(per_class)}")
    lines += [f"hint: {hint}" for hint in hints(facts)]
    if best_ap is not None and best_ap > scores["segm_AP"] + 1e-6:
        lines[0] = (
            f"best.ckpt: mask AP {best_ap:.3f}, of an earlier session; this one reached {scores['segm_AP']:.3f}"
        )
    files = [name for name in _FILES if (out / name).exists()]
    if files:
        lines.append(f"files in {out}: {', '.join(files)}")
    if "best.ckpt" in files:
        lines.append(
            f"next: cohdc export {out / 'best.ckpt'} --images {facts.images[0].path.parent}"
        )
    return lines


def _sides_on_canvas(image: CocoImage, canvas: tuple[int, int]) -> list[float]:
    """Return the square roots of the objects' box areas on the canvas, px."""
    scale = min(canvas[0] / image.height, canvas[1] / image.width)
    return [scale * math.sqrt(o.box[2] * o.box[3]) for o in image.objects if not o.crowd]


def _low_score_hint(facts: TrainingFacts) -> str:
    ap50 = facts.scores["segm_AP50"]
    if not ap50 < LOW_AP50:
        return ""
    if facts.random_weights and len(facts.images) < FEW_IMAGES:
        return (
            f"AP50 is {ap50:.3f} after {len(facts.losses)} steps from random weights on {len(facts.images)} images: "
            "start from trained ones (--pretrained auto)"
        )
    return (
        f"AP50 is {ap50:.3f} after {len(facts.losses)} steps: train longer (--minutes, --epochs), look at "
        "pictures/worst.jpg, and check the labels with cohdc data doctor and cohdc fit --overfit 8"
    )


def _loss_hint(losses: Sequence[float]) -> str:
    part = len(losses) // _PART
    if part < 10:
        return ""
    first, last = float(np.mean(losses[:part])), float(np.mean(losses[-part:]))
    if last < 0.98 * first:
        return ""
    return (
        f"the loss did not fall: {first:.3f} in the first fifth of the steps, {last:.3f} in the last: try another rate "
        "(cohdc fit --lr_find true, --model.optimizer.lr)"
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


def _anchor_hint(facts: TrainingFacts) -> str:
    ratio = facts.small_ratio()
    if ratio < MANY_SMALL:
        return ""
    smallest = min(facts.network.anchor_scales)
    return (
        f"{ratio:.0%} of the objects are smaller than {smallest // 2} px on the canvas, half the smallest "
        "anchor: a larger --data.canvas sees them"
    )


def _norm_hint(facts: TrainingFacts) -> str:
    if facts.network.norm != "batch" or facts.batch_size >= _SMALL_BATCH:
        return ""
    return (
        f"BatchNorm was trained on batches of {facts.batch_size}, and its statistics are noise below {_SMALL_BATCH} "
        "images: raise --data.batch_size, or start from trained weights with frozen norms (--pretrained auto)"
    )
