"""Find the split of a source whose folders, or lists, are named train, val and test (no torch)."""

import os
from pathlib import Path

from cohdc_train.data.formats.base import SourceDataset, SourceImage
from cohdc_train.errors import DataError

TEST = "test"
TEST_SKIPPED = "image of the test split"
_NAMES = {
    **dict.fromkeys(("train", "training"), "train"),
    **dict.fromkeys(("val", "valid", "validation"), "val"),
    **dict.fromkeys(("test", "testing"), TEST),
}


def split_named(name: str) -> str:
    """Return "train", "val" or "test" for a split's usual names, in any case; else ""."""
    return _NAMES.get(name.lower(), "")


def split_of(root: Path, *paths: Path) -> str:
    """Return the split that a folder on the way to one of the paths is named after; else "".

    root: a folder, or a file in it; folders above it do not count.
    """
    base = Path(os.path.abspath(root if root.is_dir() else root.parent))
    for path in paths:
        place = Path(os.path.abspath(path))
        folders = place.relative_to(base).parts[:-1] if place.is_relative_to(base) else ()
        named = next(filter(None, map(split_named, folders)), "")
        if named:
            return named
    return ""


def settle_splits(root: Path, source: SourceDataset) -> None:
    """Keep the source's own split, or gather the images that a split is drawn from.

    With images of both train and val the split is the source's own, and images of neither are
    skipped. Else a split is drawn from all images that are not of test. Images of test are skipped,
    unless val has them, too. Everything that is skipped is counted.

    Raises:
        DataError: there are images of test only.
    """
    test = {image.path for image in source.splits.pop(TEST, [])}
    val = {image.path for image in source.splits.get("val", [])}
    parts: dict[str, list[SourceImage]] = {}
    for name, images in source.splits.items():
        kept = [image for image in images if name == "val" or image.path not in test]
        parts |= {name: kept} if kept else {}
    if test and not parts:
        fix = "to use them, convert the folder or file named test by itself"
        raise DataError(f"{root}: all {len(test)} images are of the test split; {fix}")
    for path in sorted(test - val):
        source.skip(TEST_SKIPPED, str(path))
    if "train" in parts and "val" in parts:
        for image in parts.pop("", []):
            source.skip("image of neither train, val nor test", str(image.path))
        source.splits = {name: parts[name] for name in ("train", "val")}
        return
    source.splits = {"": [image for images in parts.values() for image in images]}
    if test or set(parts) - {""}:
        names = sorted(name or "folders of other names" for name in parts)
        source.drawn_from = " and ".join(reversed(names))
