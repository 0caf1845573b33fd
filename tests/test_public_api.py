"""Public API: all names load, and those of the robot load no torch."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import coco_toys
import numpy as np
import pytest

import cohdc_train

WITH_TORCH = {"export", "fit", "validate"}
NAMES = sorted(set(cohdc_train.__all__) - {"__version__"})
CODE = """
import sys, cohdc_train
cohdc_train.{name}
print("torch" in sys.modules, "numpy" in sys.modules)
"""
TINY = {
    "data.canvas": [48, 64],
    "data.workers": 0,
    "model.network": {
        "depth": 18,
        "width": 0.125,
        "fpn_channels": 8,
        "fc": 16,
        "anchor_scales": [8, 16, 32, 64],
    },
    "pretrained": "none",
    "trainer.accelerator": "cpu",
    "trainer.precision": "32-true",
    "trainer.enable_progress_bar": False,
    "pictures": False,
}


def loaded(name: str) -> list[str]:
    """Return whether torch and numpy are loaded after one name was, in a new process."""
    done = subprocess.run(
        [sys.executable, "-c", CODE.format(name=name)], capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def test_every_name_is_listed_and_loads() -> None:
    assert set(dir(cohdc_train)) == set(cohdc_train.__all__)
    assert all(callable(getattr(cohdc_train, name)) for name in NAMES)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        cohdc_train.nothing  # noqa: B018


def test_functions_win_over_modules_of_similar_names() -> None:
    import_module("cohdc_train.exporter.export")
    import_module("cohdc_train.prediction.predict")
    assert cohdc_train.predict.__module__ == "cohdc_train.prediction.predict"
    assert cohdc_train.export.__module__ == "cohdc_train.exporter.export"


@pytest.mark.parametrize("name", NAMES)
def test_docstring_opens_with_one_sentence(name: str) -> None:
    lines = (getattr(cohdc_train, name).__doc__ or "").splitlines()
    assert lines[0].endswith(".")
    assert lines[1] == "", "a blank line follows the first sentence"


def test_options_are_keywords_and_an_unknown_one_is_named(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'scor'"):
        cohdc_train.predict("images", model="person", out=tmp_path, scor=0.3)


def test_detections_give_masks_their_union_and_a_selection() -> None:
    boxes = np.array([[0, 0, 4, 4], [4, 2, 8, 6]], np.float32)
    ones = np.ones(2, np.float32)
    roi_masks = np.ones((2, 28, 28), np.float32)
    labels = np.array([0, 1])
    detections = cohdc_train.Detections(boxes, labels, ones, ones, roi_masks, (6, 8), ("a", "b"))
    masks = detections.masks()
    assert masks.shape == (2, 6, 8)
    assert np.array_equal(detections.mask(), masks[0] | masks[1])
    assert detections.mask().sum() == 32
    right = detections.select(np.array([False, True]))
    assert len(right) == 1
    assert np.array_equal(right.mask(), masks[1])
    assert not detections.select(np.zeros(2, bool)).mask().any()


def test_trajectory_is_saved_loaded_and_transformed(tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = (0.0, 0.5, 1.0)
    trajectory = cohdc_train.Trajectory(np.array([1.0, 2.0, 3.0]), poses)
    trajectory.save_tum(str(tmp_path / "t.txt"))
    loaded = cohdc_train.Trajectory.load_tum(str(tmp_path / "t.txt"))
    assert np.array_equal(loaded.timestamps, trajectory.timestamps)
    up = np.eye(4)
    up[2, 3] = 2.0
    assert loaded.transformed(up).positions[:, 2].tolist() == [2.0, 2.0, 2.0]
    scores = cohdc_train.evaluate(str(tmp_path / "t.txt"), str(tmp_path / "t.txt"))
    assert scores["pairs"] == 3


def test_import_costs_nothing() -> None:
    assert loaded("__version__") == ["False", "False"]


@pytest.mark.parametrize("name", sorted(set(NAMES) - WITH_TORCH))
def test_name_of_the_robot_loads_no_torch(name: str) -> None:
    assert loaded(name)[0] == "False"


def test_fit_trains_from_python(tmp_path: Path) -> None:
    data = coco_toys.folder(tmp_path / "data")
    best = cohdc_train.fit(data, tmp_path / "run", epochs=1, overrides=TINY)
    assert best == tmp_path / "run" / "best.ckpt"
    scores = cohdc_train.validate(best, data, workers=0)
    assert 0 <= scores["segm_AP50"] <= 1
