"""Weights that a training starts from: `cohdc fit --pretrained`."""

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
import yaml

from cohdc_train.errors import CohdcError
from cohdc_train.models import NetworkConfig
from cohdc_train.presets import config_path, model_path, shipped_models
from cohdc_train.train.optimizer import OptimizerConfig

FEW_IMAGES = 10_000  # below which random initial weights learn little
SHIPPED = "person"  # the shipped network that networks of its layers start from
_SHIPPED_CONFIG = "networks/hdc_net_n.yaml"
_PUBLISHED = "IMAGENET1K_V1"
# Fields of NetworkConfig that decide which layers there are, and their shapes.
SHAPE_FIELDS = (
    "backbone",
    "depth",
    "width",
    "finest_stride",
    "fpn_channels",
    "fc",
    "cqe",
    "mask_size",
    "head_norm",
)

Network = Mapping[str, Any]  # the fields of NetworkConfig by name


@dataclass(frozen=True)
class InitialWeights:
    """Source of a training's first weights.

    Attributes:
        kind: "network" is a checkpoint or exported file with weights of all layers, "backbone" a
            state dict of the backbone alone, "random" none, "resumed" the checkpoint of an
            interrupted training.
        source: file, or torchvision's name of published backbone weights; empty without weights.
        norm: norm of the backbone that these weights ask for: "frozen" or "batch".
        reason: one clause on why there are no better ones, for "random"; empty otherwise.
        stored: hyper-parameters of the checkpoint, for "resumed".
    """

    kind: Literal["network", "backbone", "random", "resumed"]
    source: str = ""
    norm: Literal["frozen", "batch"] = "frozen"
    reason: str = ""
    stored: Mapping[str, Any] = field(default_factory=dict)

    def describe(self, num_images: int) -> str:
        """Return one line for the user. num_images: training images."""
        if self.kind == "random":
            warning = f"; {num_images} images are few for that" if num_images < FEW_IMAGES else ""
            return f"initial weights: random ({self.reason}){warning}"
        named = {"network": "all layers of", "backbone": "backbone,", "resumed": "resumed from"}[
            self.kind
        ]
        return f"initial weights: {named} {self.source}"


def choose_initial_weights(
    pretrained: str, network: Network, resumed: Path | None = None
) -> InitialWeights:
    """Choose the first weights of a training.

    Args:
        pretrained: "auto" for the best that are known, "none" for random ones, "imagenet" for the
            backbone's published ones, a shipped network's name, or a file: a checkpoint, an
            exported ONNX, a state dict of the backbone.
        network: fields of the network's config. `weights`, where it is given, is what "auto" takes.
        resumed: checkpoint of an interrupted training, which holds all weights.

    Raises:
        CohdcError: there is no such file, or it cannot be read; one line names the flag.
    """
    if resumed is not None:
        stored = _read_weights(resumed)
        if "hyper_parameters" not in stored or "loops" not in stored:
            raise CohdcError(
                f"{resumed}: not a checkpoint of cohdc fit; "
                "--pretrained takes weights of other kinds"
            )
        return InitialWeights("resumed", str(resumed), stored=stored["hyper_parameters"])
    if pretrained == "none":
        return InitialWeights("random", norm="batch", reason="--pretrained none")
    if pretrained == "imagenet":
        return _published(network)
    if pretrained != "auto":
        return _from_file(pretrained)
    if network["weights"] is not None:
        return InitialWeights("backbone", str(network["weights"]))
    if _has_layers_of_shipped(network):
        return InitialWeights("network", SHIPPED)
    if network["width"] != 1.0:
        return InitialWeights(
            "random", norm="batch", reason="no weights are published for a backbone of this width"
        )
    if network["backbone"] == "mobilenet_v1":
        reason = (
            "none are published for mobilenet_v1; --pretrained FILE.pth takes a local state dict"
        )
        return InitialWeights("random", norm="batch", reason=reason)
    return _published(network)


def resolve_network(initial: InitialWeights, network: Network) -> dict[str, Any]:
    """Return the network's weights, norm and frozen_stages that follow from its initial weights.

    Raises:
        CohdcError: a norm that the user has given cannot hold the weights.
    """
    if initial.kind == "resumed":
        stored = initial.stored.get("network", {})
        undecided = {"norm": "auto", "frozen_stages": None}
        decided = {
            name: stored.get(name, network[name])
            for name, value in undecided.items()
            if network[name] == value
        }
        return {"weights": None, **decided}
    is_exported = initial.kind == "network" and model_path(initial.source).suffix == ".onnx"
    if is_exported and network["norm"] == "batch":
        raise CohdcError(
            f"{initial.source}: an exported file holds no norms to train; give "
            "--model.network.norm frozen, or start from other weights with --pretrained"
        )
    frozen_stages = network["frozen_stages"]
    if frozen_stages is None:
        frozen_stages = 0 if initial.kind == "random" else 2
    return {
        "weights": initial.source if initial.kind == "backbone" else None,
        "norm": initial.norm if network["norm"] == "auto" else network["norm"],
        "frozen_stages": frozen_stages,
    }


def resolve_backbone_lr(initial: InitialWeights, backbone_lr: float | None) -> float:
    """Return the backbone's learning rate, as a share of lr, that the initial weights ask for."""
    if backbone_lr is None and initial.kind == "resumed":
        backbone_lr = initial.stored.get("optimizer", {}).get("backbone_lr")
    config = OptimizerConfig(backbone_lr=backbone_lr).resolved(pretrained=initial.kind != "random")
    return config.backbone_lr or 0.0


def _published(network: Network) -> InitialWeights:
    """Return torchvision's weights of the backbone."""
    if network["backbone"] == "mobilenet_v1":
        raise CohdcError(
            "torchvision publishes no weights for mobilenet_v1; give a local file with "
            "--pretrained FILE.pth, or start from random weights with --pretrained none"
        )
    return InitialWeights("backbone", _PUBLISHED)


def _from_file(pretrained: str) -> InitialWeights:
    """Return the weights of a file or a shipped network."""
    path = model_path(pretrained)
    if not path.is_file():
        names = ", ".join(shipped_models())
        raise CohdcError(
            f"{pretrained}: no such file; give auto, none, imagenet, a shipped network ({names}) "
            "or a file"
        )
    if path.suffix == ".onnx":
        return InitialWeights("network", pretrained)
    stored = _read_weights(path)
    if "hyper_parameters" in stored:
        norm = stored["hyper_parameters"].get("network", {}).get("norm", "batch")
        return InitialWeights("network", pretrained, norm)
    return InitialWeights("backbone", pretrained)


def _read_weights(path: Path) -> dict[str, Any]:
    """Read what `torch.save` wrote.

    Raises:
        CohdcError: the file holds neither weights nor a checkpoint.
    """
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, ValueError, RuntimeError, pickle.UnpicklingError) as error:
        raise CohdcError(
            f"{path}: neither a checkpoint nor a state dict ({type(error).__name__})"
        ) from error
    if not isinstance(stored, dict):
        raise CohdcError(
            f"{path}: neither a checkpoint nor a state dict: it holds a {type(stored).__name__}"
        )
    return stored


def _has_layers_of_shipped(network: Network) -> bool:
    """Return whether the shipped weights fit: layers of equal shapes, except for the classes."""
    fields = yaml.safe_load(config_path(_SHIPPED_CONFIG).read_text(encoding="utf-8"))["model"][
        "network"
    ]
    shipped = NetworkConfig(**fields)
    names = [name for name in SHAPE_FIELDS if name != "depth" or network["backbone"] == "resnet"]
    return network["norm"] != "batch" and all(
        network[name] == getattr(shipped, name) for name in names
    )
