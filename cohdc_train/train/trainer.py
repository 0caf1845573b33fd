"""Lightning's trainer with this project's precision, loggers and callbacks."""

from pathlib import Path
from typing import Any, Literal

import torch
from lightning.fabric.plugins.precision.precision import _PRECISION_INPUT
from lightning.pytorch import Trainer
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger


class FitTrainer(Trainer):
    """Lightning's Trainer with one more precision.

    Args:
        precision: Lightning's, or "auto": bf16-mixed where GPU or CPU computes in it, 32-true
            elsewhere.
    """

    def __init__(
        self,
        *args: Any,
        precision: _PRECISION_INPUT | Literal["auto"] | None = "auto",
        **kwargs: Any,
    ) -> None:
        """Choose the precision and build the trainer."""
        if precision == "auto":
            precision = auto_precision(kwargs.get("accelerator", "auto"))
        super().__init__(*args, precision=precision, **kwargs)


def auto_precision(accelerator: Any = "auto") -> _PRECISION_INPUT:
    """Return "bf16-mixed" where the device multiplies bfloat16 in hardware, else "32-true"."""
    if torch.cuda.is_available() and accelerator in ("auto", "gpu", "cuda"):
        has_bf16 = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        has_bf16 = bool(torch.cpu.get_capabilities().get("avx512_bf16", False))
    return "bf16-mixed" if has_bf16 else "32-true"


def default_loggers(out: Path) -> list[Logger]:
    """Return loggers that write CSV and TensorBoard files to out/logs/version_N."""
    csv = CSVLogger(out, name="logs")
    return [csv, TensorBoardLogger(out, name="logs", version=csv.version)]
