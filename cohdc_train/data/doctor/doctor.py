"""`cohdc data doctor` and `stats`: look at a COCO-format folder without training on it (no torch)."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cohdc_train.data.coco import CocoSplit, read_split
from cohdc_train.data.doctor.anchor_recall import recall
from cohdc_train.data.doctor.sample_grid import draw_grid
from cohdc_train.data.doctor.split_checks import SplitReport, check_split
from cohdc_train.data.image_files import mirror_fingerprints
from cohdc_train.data.layout import find_split
from cohdc_train.errors import DataError
from cohdc_train.files import claim_folder, write_json
from cohdc_train.presets import config_path

_VERB = "data doctor"
_SPLITS = ("train", "val")
_SAME_IMAGE = 0.97  # product of two fingerprints; unrelated photographs reach .9
_SHOWN = 24  # counts of a split; `stats` prints all of them
_TABLE3 = range(1, 11)


def doctor(
    root: Path,
    fix: Path | None = None,
    out: Path | None = None,
    canvas: tuple[int, int] = (800, 1024),
    anchor_scales: tuple[int, ...] = (32, 64, 128, 256),
) -> None:
    """Look for everything in a COCO-format folder that would stop training or make it learn or
    score the wrong thing.

    Prints every finding with its count, three places and the mend, then the folder's statistics.
    Exit code 1 when there is an error among the findings.

    Args:
        root: the folder, in any of the usual layouts.
        fix: folder to write mended annotation files into, with `removed.json`: every row that is
            left out, and why.
        out: folder to write `issues.json` and `annotations.jpg`, a grid of annotated images,
            into.
        canvas: height and width, px, for the anchors' recall.
        anchor_scales: side of the anchors, px, one per pyramid level from stride 4.
    """
    splits = [check_split(name, find_split(root, name)) for name in _SPLITS]
    _compare_splits(*splits)
    for split in splits:
        listed = f"{len(split.content['images'])} images, {len(split.content['annotations'])} annotations"
        print(
            f"{split.name}: {split.files.annotations}: {listed} can be used, {len(split.removed)} rows cannot"
        )
        print("\n".join(split.issues.lines()) or "  nothing found")
    if fix is not None:
        _write_fixed(splits, fix)
    wrong = {split.name: split.issues.of("error") for split in splits}
    if out is not None:
        claim_folder(out, _VERB, ["issues.json", "annotations.jpg"])
        write_json(out / "issues.json", {split.name: split.issues.places for split in splits})
    count_of = sum(len(where) for kinds in wrong.values() for where in kinds.values())
    if count_of:
        kinds = ", ".join(sorted({kind for found in wrong.values() for kind in found}))
        raise DataError(
            f"{root}: {count_of} errors ({kinds}): training would stop, or learn or score the wrong thing"
        )
    readable = [read_split(split.name, split.files) for split in splits]
    _print_statistics(readable, canvas, anchor_scales)
    if out is not None:
        draw_grid(readable, out / "annotations.jpg")


def stats(root: Path, classes: list[str] | None = None) -> None:
    """Print what the splits of a COCO-format folder hold: images, objects, crowd, what had to be
    dropped or clipped.

    Args:
        root: the folder, in any of the usual layouts.
        classes: count these classes only.
    """
    splits = [read_split(name, find_split(root, name), classes) for name in _SPLITS]
    for split in splits:
        for name, value in count(split).items():
            print(f"{split.name:<6}{name:<24}{value}")
    if set(splits[0].class_names) != set(splits[1].class_names):
        raise DataError(
            f"{root}: the classes of train and val differ: {splits[0].class_names} {splits[1].class_names}"
        )


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


def summary(split: CocoSplit) -> str:
    """The counts of one split that are not zero, in one line."""
    shown = [
        f"{name} {value}" for name, value in count(split).items() if name != "annotations" and value
    ]
    return f"{split.name}: {'; '.join(shown[:_SHOWN])}" + ("; ..." if len(shown) > _SHOWN else "")


def _compare_splits(train: SplitReport, val: SplitReport) -> None:
    """Findings between the splits: classes, and images that are in both."""
    names = [
        {row["id"]: str(row["name"]) for row in split.content["categories"]}
        for split in (train, val)
    ]
    for here, there, split in ((names[0], names[1], train), (names[1], names[0], val)):
        for missing in sorted(set(here.values()) - set(there.values())):
            split.issues.add("classes-differ", missing)
    used = [
        {known.get(row["category_id"]) for row in split.content["annotations"]}
        for known, split in zip(names, (train, val), strict=True)
    ]
    for name in sorted(used[1] - used[0] & used[1], key=str):
        val.issues.add("class-only-val", str(name))
    if not train.fingerprints or not val.fingerprints:
        return
    ours, theirs = (np.stack(list(split.fingerprints.values())) for split in (train, val))
    flipped = mirror_fingerprints(theirs)
    train_names, val_names = list(train.fingerprints), list(val.fingerprints)
    for i, one in enumerate(ours):
        alike = np.maximum(theirs @ one, flipped @ one)
        for j in np.nonzero(alike > _SAME_IMAGE)[0]:
            train.issues.add("leak", f"{train_names[i]} = {val_names[j]}")


def _write_fixed(splits: Sequence[SplitReport], folder: Path) -> None:
    """Write the mended files and say how to train on them."""
    paths = [folder / f"instances_{split.name}.json" for split in splits]
    for split, path in zip(splits, paths, strict=True):
        if path.exists() and path.samefile(split.files.annotations):
            raise DataError(f"{path}: --fix would overwrite the file it reads; give another folder")
    claim_folder(folder, _VERB, [*(path.name for path in paths), "removed.json"], "--fix")
    options = []
    for split, path in zip(splits, paths, strict=True):
        write_json(path, split.content)
        options += [
            f"--data.paths.{split.name}_json {path} --data.paths.{split.name}_images {split.files.images}"
        ]
    write_json(folder / "removed.json", {split.name: split.removed for split in splits})
    print(f"mended: cohdc fit {' '.join(options)}")


def _print_statistics(
    splits: Sequence[CocoSplit], canvas: tuple[int, int], scales: Sequence[int]
) -> None:
    for split in splits:
        print(summary(split))
    print(
        f"Table 3 columns it has images enough for: {', '.join(_table3_columns(splits)) or 'none'}"
    )
    print(f"anchors {list(scales)} on a canvas of {canvas[0]}x{canvas[1]} px, objects of train:")
    boxes = _boxes(splits[0], canvas)
    for row in recall(boxes, scales, canvas):
        print(
            f"  {row.size:<8}{row.objects:>7} objects   IoU >= .5: {row.at_50:6.1%}   >= .7: {row.at_70:6.1%}"
        )


def _boxes(split: CocoSplit, canvas: tuple[int, int]) -> Any:
    """[N, 4] xyxy, px on the canvas: the objects of a split."""
    rows = []
    for image in split.images:
        scale = min(canvas[0] / image.height, canvas[1] / image.width)
        for o in image.objects:
            x, y, w, h = o.box
            rows += [] if o.crowd else [[x * scale, y * scale, (x + w) * scale, (y + h) * scale]]
    return np.array(rows).reshape(-1, 4)


def _table3_columns(splits: Sequence[CocoSplit]) -> list[str]:
    """Names of the Table 3 configurations whose subsets the splits can give."""
    names = []
    for number in _TABLE3:
        config = yaml.safe_load(
            config_path(f"table3/test{number:02}.yaml").read_text(encoding="utf-8")
        )
        wanted = config["data"]["subset"]
        if all(wanted.get(split.name, 0) <= len(split.images) for split in splits):
            names.append(f"test{number:02}")
    return names
