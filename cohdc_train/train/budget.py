"""How long a training lasts, when it validates, and the trainer that is told so."""

import math
from datetime import timedelta
from typing import Any, Literal

import torch
from lightning.fabric.plugins.precision.precision import _PRECISION_INPUT
from lightning.pytorch import Trainer

IMAGES = 6000  # that a training without a budget sees at least
EPOCHS = (12, 300)  # and fewest and most epochs of it
VALIDATIONS = (2, 8)  # fewest and most of a training that time ends
_VALIDATION_MINUTES = 5.0  # between them, within those limits
_VALIDATIONS = 4  # of a training that steps or epochs end


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
        chosen = (
            auto_precision(kwargs.get("accelerator", "auto")) if precision == "auto" else precision
        )
        super().__init__(*args, precision=chosen, **kwargs)


def auto_precision(accelerator: Any = "auto") -> _PRECISION_INPUT:
    """Return "bf16-mixed" where the device multiplies bfloat16 in hardware, else "32-true"."""
    if torch.cuda.is_available() and accelerator in ("auto", "gpu", "cuda"):
        has_bf16 = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        has_bf16 = bool(torch.cpu.get_capabilities().get("avx512_bf16", False))
    return "bf16-mixed" if has_bf16 else "32-true"


def training_limits(
    trainer: dict[str, Any], epochs: int | None, minutes: float | None
) -> dict[str, Any]:
    """Return the trainer's limits for `--epochs` and `--minutes`; whichever comes first ends the
    training.

    trainer: arguments of the trainer, of which max_epochs, max_steps and max_time are read. Raises
    ValueError for a budget that is not positive.
    """
    if epochs is not None and epochs < 1:
        raise ValueError(f"--epochs {epochs}: at least 1")
    if minutes is not None and minutes <= 0:
        raise ValueError(f"--minutes {minutes:g}: must be above 0")
    limits: dict[str, Any] = {
        name: trainer[name] for name in ("max_epochs", "max_steps", "max_time")
    }
    if epochs is not None:
        limits["max_epochs"] = epochs
    if minutes is not None:
        limits["max_time"] = timedelta(minutes=minutes)
    if limits["max_epochs"] is None and is_bounded(limits):
        limits["max_epochs"] = -1
    return limits


def is_bounded(limits: dict[str, Any]) -> bool:
    """Return whether epochs, steps or time end a training."""
    epochs, steps = limits["max_epochs"], limits["max_steps"]
    return epochs not in (None, -1) or steps not in (None, -1) or limits["max_time"] is not None


def default_epochs(num_images: int) -> int:
    """Return the epochs of a training without a budget: enough to see IMAGES images, within EPOCHS."""
    fewest, most = EPOCHS
    return min(most, max(fewest, math.ceil(IMAGES / max(1, num_images))))


def validation_interval(limits: dict[str, Any]) -> dict[str, Any]:
    """Return the trainer's arguments that spread a few validations over a training of these limits."""
    if limits["max_time"] is not None:
        whole = _as_timedelta(limits["max_time"])
        fewest, most = VALIDATIONS
        count = min(most, max(fewest, round(whole / timedelta(minutes=_VALIDATION_MINUTES))))
        return {"val_check_interval": whole / count, "check_val_every_n_epoch": None}
    if limits["max_steps"] not in (None, -1):
        steps = max(1, limits["max_steps"] // _VALIDATIONS)
        return {"val_check_interval": steps, "check_val_every_n_epoch": None}
    return {"check_val_every_n_epoch": max(1, limits["max_epochs"] // _VALIDATIONS)}


def _as_timedelta(value: Any) -> timedelta:
    """Return a duration from Lightning's forms: timedelta, "DD:HH:MM:SS", or a dict of its fields."""
    if isinstance(value, str):
        parts = value.split(":")
        if len(parts) != 4 or not all(part.isdigit() for part in parts):
            raise ValueError(
                f"--trainer.max_time {value}: give DD:HH:MM:SS, such as 00:00:10:00, or --minutes 10"
            )
        days, hours, minutes, seconds = (int(part) for part in parts)
        return timedelta(days=days, hours=hours, minutes=minutes, seconds=seconds)
    return timedelta(**value) if isinstance(value, dict) else value
