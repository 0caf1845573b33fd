"""`cohdc data`: look at a COCO-format folder without training on it (no torch)."""

from collections import Counter
from pathlib import Path
from typing import Any

from cohdc_train.data.coco import CocoSplit, read_split
from cohdc_train.data.layout import find_split
from cohdc_train.errors import DataError


def stats(root: Path, classes: list[str] | None = None) -> None:
    """Print what the splits of a COCO-format folder hold: images, objects, crowd, what had to be dropped or clipped.

    Args:
        root: the folder, in any of the usual layouts.
        classes: count these classes only.
    """
    splits = [read_split(name, find_split(root, name), classes) for name in ("train", "val")]
    for split in splits:
        for name, value in count(split).items():
            print(f"{split.name:<6}{name:<24}{value}")
    if set(splits[0].class_names) != set(splits[1].class_names):
        raise DataError(f"{root}: the classes of train and val differ: {splits[0].class_names} {splits[1].class_names}")


def count(split: CocoSplit) -> dict[str, Any]:
    """The counts of one split, in the vocabulary of the paper's Table 3; one further row per class."""
    objects = [o for image in split.images for o in image.objects]
    per_class = Counter(split.class_names[o.label - 1] for o in objects if not o.crowd)
    return {
        "annotations": split.annotations,
        "images": len(split.images),
        "objects": sum(not o.crowd for o in objects),
        "images without objects": sum(not image.objects for image in split.images),
        "crowd": sum(o.crowd for o in objects),
        "dropped": sum(split.dropped.values()),
        **{f"dropped: {reason}": number for reason, number in sorted(split.dropped.items())},
        "clipped to the image": split.clipped,
        **{f"class {name}": per_class[name] for name in split.class_names},
    }


COMMANDS = {"stats": stats}
