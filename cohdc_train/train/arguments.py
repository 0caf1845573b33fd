"""Command line of `cohdc fit`: its options, data folders by position, shipped configs by name."""

import json
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import yaml
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser

from cohdc_train.presets import config_path
from cohdc_train.train.checkpoints import BEST_DEFAULTS

USAGE = (
    "cohdc fit DATA [--config FILE.yaml] [--minutes N | --epochs N] [--out DIR] "
    "[--OPTION VALUE ...]"
)
DESCRIPTION = (
    "Train an HDC Mask R-CNN with CQE on COCO-format data. Without --config the network is "
    "networks/hdc_net_n.yaml, which starts from the shipped weights."
)
DEFAULT_NETWORK = "networks/hdc_net_n.yaml"
_NETWORK_NAMES = ("backbone", "depth")  # fields that say which network is meant
_CONFIG_OPTIONS = ("--config", "-c")
_RENAMED = {
    "pictures": "figures",
    "data.cutouts": "data.paste_roots",
    "model.optimizer.frozen_steps": "model.optimizer.backbone_freeze_steps",
}


def add_fit_arguments(parser: LightningArgumentParser) -> None:
    """Add this command's own options, and links from the data to the network and the folders."""
    parser.add_argument(
        "--out", type=Path, default=Path("runs/fit"), help="folder for everything that is written"
    )
    parser.add_argument(
        "--ckpt_path", type=Path | None, default=None, help="checkpoint of a training to resume"
    )
    parser.add_argument(
        "--pretrained",
        type=str,
        default="auto",
        help="weights to start from: auto (the shipped network where its layers fit, else "
        "published ImageNet weights), none, imagenet, a shipped network (person, person_s), or a "
        "file: checkpoint, exported ONNX, state dict of the backbone",
    )
    parser.add_argument(
        "--epochs", type=int | None, default=None, help="length of the training in epochs"
    )
    parser.add_argument(
        "--minutes", type=float | None, default=None, help="length of the training in minutes"
    )
    parser.add_argument(
        "--ema",
        type=float,
        default=0.0,
        help="decay of the weights' moving average, such as .999; 0: none",
    )
    parser.add_argument(
        "--figures",
        type=bool,
        default=True,
        help="draw figures of each validation, in OUT/figures",
    )
    parser.add_argument(
        "--lr_find",
        type=bool,
        default=False,
        help="try learning rates for 100 steps, suggest one, and stop",
    )
    parser.add_argument(
        "--overfit",
        type=int,
        default=0,
        help="train and validate on the same N images, to check the labels; 0: no",
    )
    parser.add_lightning_class_args(ModelCheckpoint, "checkpoint")
    parser.set_defaults(BEST_DEFAULTS)
    parser.link_arguments("out", "checkpoint.dirpath")
    parser.link_arguments("out", "trainer.default_root_dir")
    parser.link_arguments("overfit", "data.overfit")
    parser.link_arguments("data.canvas", "model.network.canvas", apply_on="instantiate")
    parser.link_arguments("data.class_names", "model.class_names", apply_on="instantiate")


def resolve_arguments(args: list[str]) -> list[str]:
    """Turn leading folders into `--data.root`, and names of shipped configs into their files.

    Where neither a config nor an option names a network, the default network comes first.

    Raises:
        SystemExit: an option has been renamed; the message on stderr says to what.
    """
    num_roots = next((i for i, arg in enumerate(args) if arg.startswith("-")), len(args))
    roots, options = args[:num_roots], args[num_roots:]
    _check_renamed(options)
    resolved: list[str] = []
    if not names_network(options):
        resolved += ["--config", str(config_path(DEFAULT_NETWORK))]
    if roots:
        resolved.append(f"--data.root={roots[0] if len(roots) == 1 else json.dumps(roots)}")
    for arg in options:
        name, separator, value = arg.partition("=")
        if resolved and resolved[-1] in _CONFIG_OPTIONS:
            arg = str(config_path(arg))
        elif name == "--config" and separator:
            arg = f"{name}={config_path(value)}"
        resolved.append(arg)
    return resolved


def names_network(args: list[str]) -> bool:
    """Return whether an option, or a config behind `--config`, names the network's backbone."""
    options = tuple(f"--model.network.{name}" for name in _NETWORK_NAMES)
    if any(arg.startswith(options) for arg in args):
        return True
    networks = [_value_at(content, "model.network") for _, content in _configs(args)]
    return any(name in (network or {}) for network in networks for name in _NETWORK_NAMES)


def _check_renamed(args: list[str]) -> None:
    """End the program where an option, or a key of a config, has another name now."""
    for old, new in _RENAMED.items():
        if any(arg.partition("=")[0] == f"--{old}" for arg in args):
            _end(f"no option --{old}; it is --{new} now")
        section, _, key = old.rpartition(".")
        for path, content in _configs(args):
            if key in (_value_at(content, section) or {}):
                _end(f"{path}: no option {old}; it is {new} now")


def _end(message: str) -> NoReturn:
    """End the program with the exit code of a wrong command line."""
    print(f"cohdc fit: {message}", file=sys.stderr)
    raise SystemExit(2)


def _configs(args: list[str]) -> list[tuple[Path, dict[str, Any]]]:
    """Return path and content of each config behind `--config`."""
    names = [following for arg, following in pairwise(args) if arg in _CONFIG_OPTIONS]
    names += [arg.partition("=")[2] for arg in args if arg.startswith("--config=")]
    paths = [config_path(name) for name in names]
    return [(path, yaml.safe_load(path.read_text(encoding="utf-8")) or {}) for path in paths]


def _value_at(content: dict[str, Any], section: str) -> Any:
    """Return the section of a config such as "model.network"; None where it is missing."""
    value: Any = content
    for name in filter(None, section.split(".")):
        value = value.get(name) if isinstance(value, dict) else None
    return value
