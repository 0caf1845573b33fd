"""README's Python block runs as it stands."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cohdc_train.presets import model_path

ROOT = Path(__file__).resolve().parents[1]
CAMERA = "fx: 500\nfy: 500\ncx: 320\ncy: 240\nwidth: 640\nheight: 480\ndepth_scale: 5000\n"


def test_python_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", readme, flags=re.DOTALL)
    (tmp_path / "model.onnx").symlink_to(model_path("person"))
    (tmp_path / "camera.yaml").write_text(CAMERA, encoding="utf-8")
    monkeypatch.chdir(tmp_path)

    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (480, 640, 3), dtype=np.uint8)
    depth_m = np.full((480, 640), 2.0, dtype=np.float32)
    names: dict[str, Any] = {"rgb": rgb, "depth_m": depth_m, "t": 1.0}
    exec(example, names)
    np.testing.assert_array_equal(names["pose"].T_wc, np.eye(4))
