"""Find the annotations and images of a COCO-format folder (no torch)."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cohdc_train.errors import DataError

_ALIASES = {"train": ("train",), "val": ("val", "valid")}


@dataclass(frozen=True)
class SplitPaths:
    """Annotation file of a split, and the folder that `file_name` is relative to."""

    annotations: Path
    images: Path


@dataclass(frozen=True)
class CocoPaths:
    """Places of files, for folders of an unusual layout. The two paths of a split go together.

    Attributes:
        train_json: annotation file of the training split.
        train_images: folder of its images.
        val_json: annotation file of the validation split.
        val_images: folder of its images.
    """

    train_json: Path | None = None
    train_images: Path | None = None
    val_json: Path | None = None
    val_images: Path | None = None

    def split(self, name: str) -> SplitPaths | None:
        """Return the paths of a split, or None when neither is given.

        Raises:
            DataError: only one of the two is given.
        """
        annotations: Path | None = getattr(self, f"{name}_json")
        images: Path | None = getattr(self, f"{name}_images")
        if annotations is None and images is None:
            return None
        if annotations is None or images is None:
            raise DataError(
                f"{name}_json and {name}_images go together; only one of the two is given"
            )
        return SplitPaths(annotations, images)


def find_split(root: Path, name: str) -> SplitPaths:
    """Find the paths of split `name` ("train" or "val") below `root`, in any of the usual layouts.

    `images/` + `instances_train.json`; `annotations/instances_train2017.json` + `train2017/`;
    `train/_annotations.coco.json` with its images in the same folder (Roboflow; `valid` counts as
    `val`).

    Raises:
        DataError: there is none; the message names the folder.
    """
    if not root.is_dir():
        raise DataError(f"{root}: no such folder")
    annotations = next((path for path in _annotation_places(root, name) if path.is_file()), None)
    if annotations is None:
        looked = f"instances_{name}.json, annotations/instances_{name}2017.json"
        looked += f", {name}/_annotations.coco.json"
        raise DataError(f"{root}: no annotations of split {name!r}; looked for {looked}")
    if annotations.name == "_annotations.coco.json":
        return SplitPaths(annotations, annotations.parent)
    places = list(_image_places(root, name))
    images = next((folder for folder in places if _holds_images(folder, annotations)), None)
    return SplitPaths(
        annotations, images or next((p for p in places if p.is_dir()), root / "images")
    )


def load_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        DataError: the file is missing or no JSON; the message names the file and the line.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(f"{path}: no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    except json.JSONDecodeError as error:
        raise DataError(f"{path}: line {error.lineno}: not JSON: {error.msg}") from error


def read_json(path: Path) -> dict[str, Any]:
    """Return an annotation file as a dict with lists `images`, `annotations` and `categories`.

    Raises:
        DataError: the file is missing, is no JSON, or lacks one of the lists.
    """
    content = load_json(path)
    for key in ("images", "annotations", "categories"):
        if not isinstance(content, dict) or not isinstance(content.get(key), list):
            raise DataError(f"{path}: not COCO format: no list {key!r}")
    return dict(content)


def _annotation_places(root: Path, name: str) -> Iterator[Path]:
    for alias in _ALIASES[name]:
        yield root / f"instances_{alias}.json"
        yield root / "annotations" / f"instances_{alias}2017.json"
        yield root / "annotations" / f"instances_{alias}.json"
        yield root / alias / "_annotations.coco.json"


def _image_places(root: Path, name: str) -> Iterator[Path]:
    for alias in _ALIASES[name]:
        yield root / f"{alias}2017"
        yield root / alias
        yield root / "images" / f"{alias}2017"
        yield root / "images" / alias
    yield root / "images"
    yield root


def _holds_images(folder: Path, annotations: Path) -> bool:
    """Return whether the first listed image lies in the folder."""
    if not folder.is_dir():
        return False
    images = read_json(annotations)["images"]
    return bool(images) and (folder / str(images[0].get("file_name", ""))).is_file()
