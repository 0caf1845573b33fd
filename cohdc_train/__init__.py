"""Instance segmentation training, verified ONNX export, and RGB-D SLAM that survives moving people.

Names load when they are used, so that `import cohdc_train` costs nothing and needs no torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from cohdc_train.exporter.export import export
    from cohdc_train.prediction.predict import predict
    from cohdc_train.segmenter import Detections, Segmenter
    from cohdc_train.slam.config import SlamConfig
    from cohdc_train.slam.frame import FrameResult, RGBDFrame
    from cohdc_train.slam.geometry.camera import Camera
    from cohdc_train.slam.io.sequence import open_sequence
    from cohdc_train.slam.run import run_slam
    from cohdc_train.slam.system import Slam
    from cohdc_train.train.api import fit
    from cohdc_train.trajectory.evaluate import evaluate
    from cohdc_train.trajectory.trajectory import Trajectory
    from cohdc_train.validation import validate

__all__ = [
    "Camera",
    "Detections",
    "FrameResult",
    "RGBDFrame",
    "Segmenter",
    "Slam",
    "SlamConfig",
    "Trajectory",
    "__version__",
    "evaluate",
    "export",
    "fit",
    "open_sequence",
    "predict",
    "run_slam",
    "validate",
]

_MODULES = {
    "Camera": "slam.geometry.camera",
    "Detections": "segmenter",
    "FrameResult": "slam.frame",
    "RGBDFrame": "slam.frame",
    "Segmenter": "segmenter",
    "Slam": "slam.system",
    "SlamConfig": "slam.config",
    "Trajectory": "trajectory.trajectory",
    "evaluate": "trajectory.evaluate",
    "export": "exporter.export",
    "fit": "train.api",
    "open_sequence": "slam.io.sequence",
    "predict": "prediction.predict",
    "run_slam": "slam.run",
    "validate": "validation",
}


def __getattr__(name: str) -> Any:
    """Load a public name from its module."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
