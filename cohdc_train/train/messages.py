"""Lines that `cohdc fit` prints, Lightning's that it drops, and errors of one line."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import lightning
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import Trainer
from lightning.pytorch.utilities import rank_zero_only

from cohdc_train.errors import CohdcError

# Warnings of Lightning that do not apply here, or that a line of `cohdc fit` replaces, and warnings
# about Lightning's own code by newer packages.
_DROPPED_WARNINGS = (
    ".*does not have many workers.*",
    ".*is smaller than the logging interval.*",
    ".*Checkpoint directory.*",
    ".*could not find the monitored key.*",  # an error where there is a validation
    ".*The dirpath has changed from.*",
    ".*The checkpoint was not created with WeightAveraging.*",
    ".*args parameter is intended to run from within Python.*",
    r".*isinstance\(treespec, LeafSpec\).*",
    r"(?s).*(JSONARGPARSE_DEPRECATION_WARNINGS|was\s+deprecated\s+in\s+v4).*",
)
_LIGHTNING = Path(lightning.__file__).parent
# Callbacks whose messages nobody asked for; those of others are printed on request only.
_CHATTY_CALLBACKS = ("timer.py", "model_summary.py", "weight_averaging.py")


@rank_zero_only
def say(line: str) -> None:
    """Print a line in the first process."""
    print(line, flush=True)


def device_line(trainer: Trainer) -> str:
    """Return one line on the device, its precision and the threads of a training."""
    device = trainer.strategy.root_device
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type.upper()
    count = f"{trainer.world_size} x " if trainer.world_size > 1 else ""
    threads = torch.get_num_threads()
    return (
        f"device: {count}{name}, precision {trainer.precision}, "
        f"{threads} thread{'s' if threads > 1 else ''}"
    )


@contextmanager
def user_errors() -> Iterator[None]:
    """Turn what a user can cause into a CohdcError of one line, and silence Lightning's advice.

    Causes are bad values, files, and a reader's error in a worker process. Warnings of other
    packages and of the user's own code are shown.
    """
    with warnings.catch_warnings(), _without_lightning_info():
        for message in _DROPPED_WARNINGS:
            warnings.filterwarnings("ignore", message)
        try:
            yield
        except CohdcError as error:
            raise CohdcError(_last_message(str(error))) from error
        except (MisconfigurationException, FileNotFoundError) as error:
            raise CohdcError(" ".join(str(error).split())) from error


def _last_message(text: str) -> str:
    """Return the last line of an error.

    A worker process sends a traceback, whose last line is the error's name and message.
    """
    lines = text.strip().splitlines()
    last = lines[-1] if lines else "no message"
    return (last.partition("Error: ")[2] or last) if len(lines) > 1 else last


@contextmanager
def _without_lightning_info() -> Iterator[None]:
    """Drop Lightning's own messages below a warning; messages that other code logs are kept."""
    handlers = list(logging.getLogger().handlers)
    for name in ("lightning", "lightning.pytorch", "lightning.fabric"):
        handlers += logging.getLogger(name).handlers
    for handler in handlers:
        handler.addFilter(_is_wanted)
    try:
        yield
    finally:
        for handler in handlers:
            handler.removeFilter(_is_wanted)


def _is_wanted(record: logging.LogRecord) -> bool:
    """Return False for a message that Lightning's code logs below a warning."""
    path = Path(record.pathname)
    if record.levelno >= logging.WARNING or _LIGHTNING not in path.parents:
        return True
    return path.parent.name == "callbacks" and path.name not in _CHATTY_CALLBACKS
