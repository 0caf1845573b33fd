"""Check a COCO-format folder without training on it: `cohdc data doctor` and `stats` (no torch)."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from cohdc_train.data.canvas import choose_canvas
from cohdc_train.data.coco import CocoSplit, read_split
from cohdc_train.data.doctor.anchor_recall import anchor_recall
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
    canvas: tuple[int, int] | Literal["auto"] = "auto",
    anchor_scales: tuple[int, ...] = (32, 64, 128, 256),
) -> None:
    """Find everything in a COCO-format folder that would stop training or spoil what it learns.

    Prints every issue with its count, three places and the fix, then the folder's statistics. The
    exit code is 1 when one of the issues is an error.

    Args:
        root: the folder, in any of the usual layouts.
        fix: folder to write fixed annotation files into, with `removed.json`: every row that was
            removed, and why.
        out: folder to write `issues.json` and `annotations.jpg`, a grid of annotated images, into.
        canvas: height and width, px, for the recall of the anchors; "auto" chooses it from the
            training images, as `cohdc fit` does.
        anchor_scales: side of the anchors, px, one per pyramid level from stride 4.
    """
    splits = [check_split(name, find_split(root, name)) for name in _SPLITS]
    _compare_splits(*splits)
    for split in splits:
        images, annotations = (len(split.content[key]) for key in ("images", "annotations"))
        usable = f"{images} images, {annotations} annotations can be used"
        print(
            f"{split.name}: {split.files.annotations}: {usable}, {len(split.removed)} rows cannot"
        )
        print("\n".join(split.issues.summary_lines()) or "  nothing found")
    if fix is not None:
        _write_fixed(splits, fix)
    wrong = {split.name: split.issues.of_severity("error") for split in splits}
    if out is not None:
        claim_folder(out, _VERB, ["issues.json", "annotations.jpg"])
        write_json(out / "issues.json", {split.name: split.issues.places for split in splits})
    count_of = sum(len(where) for kinds in wrong.values() for where in kinds.values())
    if count_of:
        kinds = ", ".join(sorted({kind for found in wrong.values() for kind in found}))
        effect = "training would stop, or learn or score the wrong thing"
        raise DataError(f"{root}: {count_of} errors ({kinds}): {effect}")
    readable = [read_split(split.name, split.files) for split in splits]
    _print_statistics(readable, canvas, anchor_scales)
    if out is not None:
        draw_grid(readable, out / "annotations.jpg")


def stats(root: Path, classes: list[str] | None = None) -> None:
    """Print what a COCO-format folder holds: images, objects, crowds, and what reading would drop.

    Args:
        root: the folder, in any of the usual layouts.
        classes: count these classes only.
    """
    splits = [read_split(name, find_split(root, name), classes) for name in _SPLITS]
    for split in splits:
        for name, value in count_objects(split).items():
            print(f"{split.name:<6}{name:<24}{value}")
    if set(splits[0].class_names) != set(splits[1].class_names):
        train, val = (split.class_names for split in splits)
        raise DataError(f"{root}: the classes of train and val differ: {train} {val}")


def count_objects(split: CocoSplit) -> dict[str, Any]:
    """Return the counts of one split, named as in Table 3 of the paper, and of each class."""
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
    """Return the counts of one split that are not zero, in one line."""
    counts = {name: value for name, value in count_objects(split).items() if name != "annotations"}
    shown = [f"{name} {value}" for name, value in counts.items() if value]
    more = "; ..." if len(shown) > _SHOWN else ""
    return f"{split.name}: {'; '.join(shown[:_SHOWN])}{more}"


def _compare_splits(train: SplitReport, val: SplitReport) -> None:
    """Add issues between the splits: classes that differ, and images that are in both."""
    _compare_classes(train, val)
    if train.fingerprints and val.fingerprints:
        _find_leaks(train, val)


def _compare_classes(train: SplitReport, val: SplitReport) -> None:
    """Add issues of classes that one split lacks."""
    in_train, in_val = _category_names(train), _category_names(val)
    for name in sorted(set(in_train.values()) - set(in_val.values())):
        train.issues.add("classes-differ", name)
    for name in sorted(set(in_val.values()) - set(in_train.values())):
        val.issues.add("classes-differ", name)

    learned = {in_train.get(row["category_id"]) for row in train.content["annotations"]}
    scored = {in_val.get(row["category_id"]) for row in val.content["annotations"]}
    for unlearned in sorted(scored - learned, key=str):
        val.issues.add("class-only-val", str(unlearned))


def _category_names(split: SplitReport) -> dict[int, str]:
    """Return the name of each category id."""
    return {row["id"]: str(row["name"]) for row in split.content["categories"]}


def _find_leaks(train: SplitReport, val: SplitReport) -> None:
    """Add an issue for each training image that equals a validation image, or its mirror image."""
    prints = np.stack(list(val.fingerprints.values()))
    flipped = mirror_fingerprints(prints)
    val_names = list(val.fingerprints)
    for name, one in train.fingerprints.items():
        similarity = np.maximum(prints @ one, flipped @ one)
        for j in np.nonzero(similarity > _SAME_IMAGE)[0]:
            train.issues.add("leak", f"{name} = {val_names[j]}")


def _write_fixed(splits: Sequence[SplitReport], folder: Path) -> None:
    """Write the fixed files, and print how to train on them."""
    paths = [folder / f"instances_{split.name}.json" for split in splits]
    for split, path in zip(splits, paths, strict=True):
        if path.exists() and path.samefile(split.files.annotations):
            raise DataError(f"{path}: --fix would overwrite the file it reads; give another folder")
    claim_folder(folder, _VERB, [*(path.name for path in paths), "removed.json"], "--fix")
    options = []
    for split, path in zip(splits, paths, strict=True):
        write_json(path, split.content)
        options += [f"--data.paths.{split.name}_json {path}"]
        options += [f"--data.paths.{split.name}_images {split.files.images}"]
    write_json(folder / "removed.json", {split.name: split.removed for split in splits})
    print(f"fixed: cohdc fit {' '.join(options)}")


def _print_statistics(
    splits: Sequence[CocoSplit], canvas: tuple[int, int] | Literal["auto"], scales: Sequence[int]
) -> None:
    for split in splits:
        print(summary(split))
    columns = ", ".join(_table3_columns(splits)) or "none"
    print(f"Table 3 columns it has images enough for: {columns}")
    train = splits[0]
    height, width = _canvas_size(train, canvas)
    origin = "that cohdc fit chooses" if canvas == "auto" else "of --canvas"
    print(f"anchors {list(scales)} on the canvas {origin}, {height}x{width} px, objects of train:")
    boxes = _boxes(train, (height, width))
    for row in anchor_recall(boxes, scales, (height, width)):
        shares = f"IoU >= .5: {row.at_50:6.1%}   >= .7: {row.at_70:6.1%}"
        print(f"  {row.size:<8}{row.objects:>7} objects   {shares}")


def _canvas_size(train: CocoSplit, canvas: tuple[int, int] | Literal["auto"]) -> tuple[int, int]:
    """Return (height, width), px."""
    if canvas == "auto":
        return choose_canvas([(image.height, image.width) for image in train.images])
    return canvas


def _boxes(split: CocoSplit, canvas: tuple[int, int]) -> Any:
    """Return the objects of a split, [N, 4] xyxy, px on the canvas."""
    rows = []
    for image in split.images:
        scale = min(canvas[0] / image.height, canvas[1] / image.width)
        for o in image.objects:
            x, y, w, h = o.box
            rows += [] if o.crowd else [[x * scale, y * scale, (x + w) * scale, (y + h) * scale]]
    return np.array(rows).reshape(-1, 4)


def _table3_columns(splits: Sequence[CocoSplit]) -> list[str]:
    """Return the names of the Table 3 configurations whose subsets the splits can give."""
    names = []
    for number in _TABLE3:
        config = yaml.safe_load(
            config_path(f"table3/test{number:02}.yaml").read_text(encoding="utf-8")
        )
        wanted = config["data"]["subset"]
        if all(wanted.get(split.name, 0) <= len(split.images) for split in splits):
            names.append(f"test{number:02}")
    return names
