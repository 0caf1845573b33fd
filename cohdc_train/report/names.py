"""Names, units and digits of the numbers that runs write, as a person says them."""

import math
from collections.abc import Mapping
from typing import NamedTuple


class Quantity(NamedTuple):
    """Name, unit and digits with which a number is shown.

    name: without the unit; unit: empty for a share of 1 and for counts; digits: behind the point;
    better: +1 when larger is better, -1 when smaller is, 0 when neither.
    """

    name: str
    unit: str = ""
    digits: int = 3
    better: int = 0

    @property
    def title(self) -> str:
        """Name and unit, as the head of a column."""
        return f"{self.name}, {self.unit}" if self.unit else self.name

    def text(self, value: float) -> str:
        """Return a value with this quantity's digits, without its unit."""
        return "undefined" if math.isnan(value) else f"{value:.{self.digits}f}"


ERRORS: Mapping[str, Quantity] = {
    "ate_m": Quantity("Translation error (ATE)", "m", 4, -1),
    "rpe_1s_m": Quantity("Translation drift per second (RPE)", "m", 4, -1),
    "rpe_1s_deg": Quantity("Rotation drift per second (RPE)", "°", 3, -1),
    "rpe_all_pairs_m": Quantity("Relative error over all pairs (RPE, TUM's default)", "m", 4, -1),
}
STATISTICS: Mapping[str, str] = {
    "rmse": "RMSE",
    "mean": "Mean",
    "median": "Median",
    "std": "Std. dev.",
    "min": "Min.",
    "max": "Max.",
}
STAGES: Mapping[str, str] = {
    "depth": "Stereo depth",
    "segment": "Segmentation",
    "track": "Tracking",
    "map": "Mapping, per keyframe",
}
REALTIME: Mapping[str, str] = {
    "latency_ms": "Latency, stamp to pose",
    "mask_age_ms": "Age of the masks",
    "segmenter_ms": "Segmentation, beside tracking",
}

_KINDS = {"segm": "Mask", "boundary": "Boundary", "box": "Box"}
_SCORES: Mapping[str, Quantity] = {
    "mIoU": Quantity("Mean IoU", "", 3, 1),
    "S90_matched": Quantity("Masks above IoU 0.9, of the matched", "", 3, 1),
    "S90_all": Quantity("Masks above IoU 0.9, of all objects", "", 3, 1),
    "quality_spearman": Quantity("Quality against true IoU (Spearman)", "", 3, 1),
    "quality_error": Quantity("Mean error of the quality", "", 3, -1),
    "quality_cut": Quantity("Quality below which a mask is cut", "", 3),
}
BENCH: Mapping[str, Quantity] = {
    "train_seconds": Quantity("Training", "s", 0, -1),
    "fps_torch": Quantity("Speed, PyTorch", "images/s", 2, 1),
    "fps_ort": Quantity("Speed, ONNX", "images/s", 2, 1),
    "fps_ort_int8": Quantity("Speed, ONNX int8", "images/s", 2, 1),
    "model_mb": Quantity("File, ONNX", "MB", 1, -1),
    "model_mb_int8": Quantity("File, ONNX int8", "MB", 1, -1),
    "ap": Quantity("Mask AP", "", 3, 1),
    "ap_int8": Quantity("Mask AP, int8", "", 3, 1),
    "boundary_ap": Quantity("Boundary AP", "", 3, 1),
    "s90_matched": Quantity("Masks above IoU 0.9, of the matched", "", 3, 1),
    "s90_all": Quantity("Masks above IoU 0.9, of all objects", "", 3, 1),
    "peak_mb": Quantity("Peak memory", "MiB", 0, -1),
    "vertices": Quantity("Vertices per outline", "", 1, -1),
}


def score_quantity(key: str) -> Quantity:
    """Return how a segmentation score is shown, such as `segm_AP50` or `boundary_AP`.

    An unknown key is its own name with spaces for underscores.
    """
    kind, _, rest = key.partition("_")
    if kind in _KINDS and rest[:2] in ("AP", "AR"):
        threshold = rest[2:]
        at = f" at IoU {int(threshold) / 100:g}" if threshold.isdecimal() else ""
        rest = f"{rest[:2]}{at}" if at or not threshold else rest
        return Quantity(f"{_KINDS[kind]} {rest}", "", 3, 1)
    return _SCORES.get(key, Quantity(key.replace("_", " ")))


def count(number: int, singular: str, plural: str | None = None) -> str:
    """Return a number with its noun: `1 loop`, `2 loops`, `1 234 frames`."""
    noun = singular if number == 1 else plural or f"{singular}s"
    return f"{number:,} {noun}".replace(",", "\u202f")


def seconds(value: float) -> str:
    """Return a duration: `26.3 s`, `4 min 12 s`, `2 h 05 min`."""
    if value < 60:
        return f"{value:.1f} s"
    minutes, rest = divmod(round(value), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"
