"""`cohdc validate` of an ONNX file: what it reads."""

from pathlib import Path

import coco_toys as toys
import numpy as np
import pytest

from cohdc_train import validation
from cohdc_train.data import coco
from cohdc_train.errors import CohdcError
from cohdc_train.segmenter import Detections
from cohdc_train.validation import score_file, validate


class BlindSegmenter:
    """Stands for an ONNX file that knows one class of the folder and finds nothing."""

    class_names = ("car", "tree")

    def __init__(self, model: Path, num_threads: int = 0) -> None:
        """Take any file."""

    def __call__(self, rgb: np.ndarray) -> Detections:
        """Return no detection."""
        size = (rgb.shape[0], rgb.shape[1])
        none = np.zeros(0, np.float32)
        masks = np.zeros((0, 28, 28), np.float32)
        boxes = np.zeros((0, 4), np.float32)
        return Detections(boxes, np.zeros(0, np.int64), none, none, masks, size, self.class_names)


@pytest.fixture
def model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(validation, "Segmenter", BlindSegmenter)
    (tmp_path / "blind.onnx").touch()
    return tmp_path / "blind.onnx"


def test_validation_of_onnx_reads_annotations_once(
    tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = toys.folder(tmp_path / "data")
    read_files = []
    read_json = coco.read_json
    monkeypatch.setattr(coco, "read_json", lambda path: read_files.append(path) or read_json(path))

    scores = validate(model, root, figures=tmp_path / "figures")

    assert read_files == [root / "instances_val.json"]
    assert scores["segm_AP50"] == 0
    assert (tmp_path / "figures" / "worst.jpg").is_file()


def test_validation_of_onnx_scores_common_classes_only(tmp_path: Path, model: Path) -> None:
    results = score_file(model, toys.folder(tmp_path / "data"))
    assert [row["name"] for row in results.truth["categories"]] == ["car"]
    assert {row["category_id"] for row in results.truth["annotations"]} == {1}


def test_validation_of_onnx_without_common_class_is_refused(
    tmp_path: Path, model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(BlindSegmenter, "class_names", ("tree",))
    with pytest.raises(CohdcError, match=r"none of its 1 classes is one of .*: person, car$"):
        score_file(model, toys.folder(tmp_path / "data"))
