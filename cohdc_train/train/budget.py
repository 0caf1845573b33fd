"""Length of a training, and the interval of its validations."""

import math
from datetime import timedelta
from typing import Any

IMAGES = 6000  # least number of images that a training without a budget sees
EPOCHS = (12, 300)  # fewest and most epochs of a training without a budget
VALIDATIONS = (2, 8)  # fewest and most validations of a training that time ends
_VALIDATION_MINUTES = 5.0  # between the validations of such a training, within those limits
_VALIDATIONS = 4  # validations of a training that steps or epochs end


def training_limits(
    trainer: dict[str, Any], epochs: int | None, minutes: float | None
) -> dict[str, Any]:
    """Return the trainer's limits for `--epochs` and `--minutes`; the first one reached ends it.

    Args:
        trainer: arguments of the trainer, of which max_epochs, max_steps and max_time are read.
        epochs: of `--epochs`.
        minutes: of `--minutes`.

    Raises:
        ValueError: the budget is not positive.
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
    """Return the epochs of a training without a budget: to see IMAGES images, within EPOCHS."""
    fewest, most = EPOCHS
    return min(most, max(fewest, math.ceil(IMAGES / max(1, num_images))))


def validation_interval(limits: dict[str, Any]) -> dict[str, Any]:
    """Return the trainer's arguments that spread a few validations over a training."""
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
    """Convert Lightning's forms of a duration: timedelta, "DD:HH:MM:SS", dict of its fields."""
    if isinstance(value, str):
        parts = value.split(":")
        if len(parts) != 4 or not all(part.isdigit() for part in parts):
            raise ValueError(
                f"--trainer.max_time {value}: give DD:HH:MM:SS, such as 00:00:10:00, "
                "or --minutes 10"
            )
        days, hours, minutes, seconds = (int(part) for part in parts)
        return timedelta(days=days, hours=hours, minutes=minutes, seconds=seconds)
    return timedelta(**value) if isinstance(value, dict) else value
