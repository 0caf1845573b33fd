"""Options of a resumed training against those that its checkpoint was made with."""

from collections.abc import Iterator, Mapping, MutableMapping
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer

from cohdc_train.errors import CohdcError
from cohdc_train.train.initial_weights import SHAPE_FIELDS
from cohdc_train.train.optimizer import option_name

KEY = "fit_options"  # key in checkpoints of options that are no hyper-parameters
_WEIGHT_FIELDS = (*SHAPE_FIELDS, "norm", "frozen_stages")  # decide which weights are trained
_RESTORED_FIELDS = ("lr", "weight_decay", "momentum")  # part of the optimizer's state
_AVERAGE = "current_model_state"  # Lightning's key for the plain weights of an averaged training


class OptionsRecorder(Callback):
    """Writes options of the training into its checkpoints, for a later resume to compare.

    Args:
        options: batch_size, ema and precision.
    """

    def __init__(self, options: Mapping[str, Any]) -> None:
        """Take the options as they are when a checkpoint is saved."""
        self.options = options

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the options."""
        checkpoint[KEY] = dict(self.options)


def check_resumable(
    stored: Mapping[str, Any], asked: Mapping[str, Any], source: Path = Path("CHECKPOINT")
) -> None:
    """Refuse to resume where the checkpoint's weights or optimizer cannot fit.

    Args:
        stored: hyper-parameters of the checkpoint: class_names, network, optimizer.
        asked: those of the training that shall resume it.
        source: file of the checkpoint.

    Raises:
        CohdcError: classes, network or optimizer differ; one line says how, and what to do.
    """
    theirs, own = list(stored.get("class_names", [])), list(asked["class_names"])
    if theirs != own:
        raise CohdcError(
            f"{source}: its classes are {', '.join(theirs)}; the data's are {', '.join(own)}; "
            f"--pretrained {source} starts a new training from its weights"
        )
    for section, names in (("network", _WEIGHT_FIELDS), ("optimizer", ("name",))):
        for name, before, now in _differences(stored, asked, section):
            if name in names:
                raise CohdcError(
                    f"{source}: its {section} has {name} {before}, this one {now}; give --config "
                    "of its training, the config.yaml next to it, or start a new training from "
                    f"its weights with --pretrained {source}"
                )


def resume_notes(source: Path, asked: Mapping[str, Any], options: Mapping[str, Any]) -> list[str]:
    """Compare a checkpoint with the training that resumes it.

    Args:
        source: file of the checkpoint.
        asked: hyper-parameters of the training: class_names, network, optimizer, rescore.
        options: batch_size, ema and precision of the training.

    Returns:
        One line for each option that differs: the checkpoint's value, the value that was asked for,
        and which of them is used.

    Raises:
        CohdcError: as `check_resumable`.
    """
    checkpoint = torch.load(source, map_location="cpu", weights_only=True)
    stored = checkpoint.get("hyper_parameters", {})
    check_resumable(stored, asked, source)
    notes = []
    for name, before, now in _differences(stored, asked, "network"):
        if name == "canvas":
            notes.append(_note("--data.canvas", before, now))
        elif name != "weights":
            notes.append(_note(f"--model.network.{name}", before, now))
    for name, before, now in _differences(stored, asked, "optimizer"):
        notes.append(_note(f"--model.optimizer.{option_name(name)}", before, now))
    if stored.get("rescore", asked["rescore"]) != asked["rescore"]:
        notes.append(_note("--model.rescore", stored["rescore"], asked["rescore"]))
    notes += _option_notes(checkpoint, options)
    return notes


def _option_notes(checkpoint: Mapping[str, Any], options: Mapping[str, Any]) -> Iterator[str]:
    """Yield notes on batch size, precision and weight average, where the checkpoint has them."""
    stored = checkpoint.get(KEY, {})
    for name, option in (("batch_size", "--data.batch_size"), ("precision", "--trainer.precision")):
        if name in stored and stored[name] != options[name]:
            yield _note(option, stored[name], options[name])

    was_averaged, is_averaged = _AVERAGE in checkpoint, bool(options["ema"])
    before = stored.get("ema", "on" if was_averaged else 0.0)
    if was_averaged and not is_averaged:
        used = "the training continues from the average, without a new one"
        yield _note("--ema", before, options["ema"], used)
    elif is_averaged and not was_averaged:
        yield _note("--ema", before, options["ema"], "the average starts at the checkpoint")
    elif is_averaged and "ema" in stored and before != options["ema"]:
        yield _note("--ema", before, options["ema"])


def _differences(
    stored: Mapping[str, Any], asked: Mapping[str, Any], section: str
) -> Iterator[tuple[str, Any, Any]]:
    """Yield name, checkpoint's value and asked value of the fields that differ in a section."""
    theirs = stored.get(section, {})
    for name, now in asked[section].items():
        before = theirs.get(name, now)
        if _plain(before) != _plain(now):
            yield name, before, now


def _plain(value: Any) -> Any:
    """Turn tuples into lists, as a configuration file gives them."""
    return [_plain(one) for one in value] if isinstance(value, tuple | list) else value


def _note(option: str, before: Any, now: Any, used: str = "") -> str:
    """Return a line on an option; used: what is used, the value that was asked for if empty."""
    used = used or f"{now} is used"
    return f"resume: {option}: {before} in the checkpoint, {now} was asked for; {used}"


def keep_restored_options(
    stored: Mapping[str, Any], optimizer: MutableMapping[str, Any]
) -> list[str]:
    """Replace the options that come back with the optimizer's state by the checkpoint's, in place.

    Args:
        stored: hyper-parameters of the checkpoint; empty where nothing is resumed.
        optimizer: options of `--model.optimizer`.

    Returns:
        One line for each option that differed.
    """
    notes = []
    for name in _RESTORED_FIELDS:
        before = stored.get("optimizer", {}).get(name, optimizer[name])
        if before != optimizer[name]:
            used = f"{before} is used; --pretrained CHECKPOINT starts with another one"
            notes.append(_note(f"--model.optimizer.{name}", before, optimizer[name], used))
            optimizer[name] = before
    return notes
