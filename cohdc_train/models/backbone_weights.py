"""Weights of a backbone: published ones by name, or a file with a state dict."""

import pickle
from pathlib import Path

import torch
from torch import Tensor
from torchvision.models import get_model_weights

from cohdc_train.models.backbone import Backbone


def load_weights(backbone: Backbone, source: str, state: dict[str, Tensor], name: str) -> None:
    """Fill a backbone with a state dict; tensors that it has no layer for are ignored.

    Args:
        backbone: the backbone.
        source: file or name of the weights, for messages.
        state: tensors by name.
        name: name of the backbone, for messages.

    Raises:
        ValueError: a tensor is missing or of another shape; the message names source and tensor.
    """
    own = backbone.state_dict()
    for key in (key for key in own if not key.endswith("num_batches_tracked")):
        if key not in state:
            raise ValueError(f"{source}: no tensor {key}; these are not {name} weights")
        if state[key].shape != own[key].shape:
            raise ValueError(
                f"{source}: {key} is {list(state[key].shape)}, "
                f"the backbone's {list(own[key].shape)}"
            )
    known = {key: value for key, value in state.items() if key in own}
    backbone.load_state_dict(known, strict=False)


def read_weights(weights: str, model: str | None) -> dict[str, Tensor]:
    """Read a state dict: a file that `torch.save` wrote, or torchvision's weights by name.

    Args:
        weights: path of a file, or a name such as "IMAGENET1K_V1".
        model: torchvision's name of the model; None where no weights are published.

    Raises:
        FileNotFoundError: there is no such file and no such name, or the download fails.
        ValueError: the file holds no state dict.
    """
    if Path(weights).is_file():
        return _read_state_dict(Path(weights))
    published = {} if model is None else get_model_weights(model).__members__
    if weights not in published:
        names = "torchvision publishes none"
        if model is not None:
            names = f"torchvision's {model} weights are {', '.join(published)}"
        raise FileNotFoundError(f"{weights}: no such file, and {names}")
    try:
        fetched: dict[str, Tensor] = published[weights].get_state_dict(progress=True)
    except (OSError, RuntimeError) as error:  # no network, or not the published file
        reason = " ".join(str(error).split())
        raise FileNotFoundError(
            f"{weights} of {model}: the download of {published[weights].url} failed ({reason}); "
            "give a local file with --pretrained FILE.pth, or start from random weights with "
            "--pretrained none"
        ) from error
    return fetched


def _read_state_dict(path: Path) -> dict[str, Tensor]:
    """Read the tensors of a file that `torch.save` wrote; ValueError when it is none."""
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, ValueError, RuntimeError, pickle.UnpicklingError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{path}: not a file of torch weights: {reason}") from error
    if not isinstance(stored, dict) or not all(torch.is_tensor(value) for value in stored.values()):
        raise ValueError(f"{path}: not a state dict of a backbone, which holds tensors only")
    return dict(stored)
