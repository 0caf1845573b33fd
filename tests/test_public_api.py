"""Public API: all names load, and those of the robot load no torch."""

import subprocess
import sys
from pathlib import Path

import coco_toys
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
