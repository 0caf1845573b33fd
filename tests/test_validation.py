"""`cohdc validate` of ONNX files: the classes that file and folder have in common."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import coco_toys
import pytest

pytest.importorskip("torch", reason="cohdc validate comes with the train extra")

from cohdc_train.data import coco
from cohdc_train.data.coco import read_folder
from cohdc_train.errors import CohdcError
from cohdc_train.validation import common_split


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Make a folder of people and cars."""
    return coco_toys.folder(tmp_path)


def test_annotation_files_are_read_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files: list[str] = []
    read_json: Callable[[Path], dict[str, Any]] = coco.read_json

    def count(path: Path) -> dict[str, Any]:
        files.append(path.name)
        return read_json(path)

    monkeypatch.setattr(coco, "read_json", count)
    common_split(folder, Path("m.onnx"), ["car"])
    assert sorted(files) == ["instances_train.json", "instances_val.json"]


@pytest.mark.parametrize("names", [["car"], ["person"], ["car", "person"]])
def test_common_split_equals_a_folder_read_with_these_classes(
    folder: Path, names: list[str]
) -> None:
    split = common_split(folder, Path("m.onnx"), ["tree", *names])
    expected = read_folder([folder], names).val
    assert split.class_names == expected.class_names
    assert split.ground_truth() == expected.ground_truth()


def test_folder_without_a_known_class_is_one_line(folder: Path) -> None:
    with pytest.raises(
        CohdcError, match=r"^m\.onnx: none of its 2 classes is one of .*: person, car$"
    ):
        common_split(folder, Path("m.onnx"), ["tree", "dog"])
