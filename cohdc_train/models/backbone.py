"""What every backbone here is: a stem and four stages of strides 4, 8, 16, 32, whose 3x3
convolutions are dilated.
"""

import pickle
from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Literal, Self

import torch
from torch import Tensor, nn
from torchvision.models import get_model_weights

from cohdc_train.models.frozen_norm import FrozenNorm, apply_norms_in_convolutions
from cohdc_train.models.hdc import cycle

Rates = Sequence[Sequence[int]]
Norm = Literal["batch", "frozen"]  # frozen keeps statistics and scale
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet, RGB in 0..1


def norm_layer(norm: Norm, eps: float = 1e-5) -> Callable[[int], nn.Module]:
    """Channels -> the norm behind a convolution."""
    return partial(nn.BatchNorm2d if norm == "batch" else FrozenNorm, eps=eps)


def rounded(channels: float) -> int:
    """The nearest multiple of 8, at least 8."""
    return max(8, round(channels / 8) * 8)


class StagedBackbone(nn.Module):
    """Base of the backbones; a subclass builds its parts and then calls `finish`.

    Attributes:
        out_channels: channels of the four stages.
        frozen_stages: how many of the stem and the stages are not trained, counted from the stem.
    """

    out_channels: list[int]
    frozen_stages = 0

    def parts(self) -> list[list[nn.Module]]:
        """The modules of the stem and of each stage, in the order in which they run."""
        raise NotImplementedError

    def stem(self, x: Tensor) -> Tensor:
        """x: [B, 3, H, W], normalised by ImageNet's mean and deviation. Returns what the first
        stage takes.
        """
        raise NotImplementedError

    def field_of_stem(self) -> tuple[int, int]:
        """(side of what a cell behind the stem sees, stride of the stem), px."""
        raise NotImplementedError

    def finish(self, rates: Rates, frozen_stages: int) -> None:
        """Dilate, start from He's initialisation, freeze.

        rates: dilation pattern of each of the four stages, cycled over its convolutions; (1,) is a
        plain stage. Raises ValueError: a pattern leaves holes (they are named), or there are not
        four patterns.
        """
        if len(rates) != 4:
            raise ValueError(f"HDC rates {tuple(rates)}: {len(rates)} patterns for 4 stages")
        for stage, pattern in zip(self.parts()[1:], rates, strict=True):
            dilate(stage, pattern)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")
        apply_norms_in_convolutions(self)
        self.frozen_stages = frozen_stages
        for frozen in self._frozen():
            frozen.requires_grad_(False)

    def forward(self, x: Tensor) -> "OrderedDict[str, Tensor]":
        """x: [B, 3, H, W], normalised; sides are multiples of 32. Returns {"0": stride 4, "1": 8,
        "2": 16, "3": 32} feature maps.
        """
        x = self.stem(x)
        features = OrderedDict()
        for i, stage in enumerate(self.parts()[1:]):
            for module in stage:
                x = module(x)
            features[str(i)] = x
        return features

    def rates(self) -> list[tuple[int, ...]]:
        """Dilations of each stage's 3x3 convolutions, in their order."""
        return [tuple(c.dilation[0] for c in _convolutions(stage)) for stage in self.parts()[1:]]

    def receptive_field(self) -> int:
        """Side, in px of the input, of what a cell of the last stage sees."""
        side, jump = self.field_of_stem()
        for stage in self.parts()[1:]:
            for conv in _convolutions(stage):
                side += 2 * conv.dilation[0] * jump
                jump *= conv.stride[0]
        return side

    def train(self, mode: bool = True) -> Self:
        """As nn.Module's, but frozen stages stay in evaluation mode, so that their BatchNorm
        statistics rest.
        """
        super().train(mode)
        for frozen in self._frozen():
            frozen.eval()
        return self

    def _frozen(self) -> list[nn.Module]:
        return [module for part in self.parts()[: self.frozen_stages] for module in part]


def dilate(stage: Sequence[nn.Module], pattern: Sequence[int]) -> None:
    """Set the dilation of a stage's 3x3 convolutions in place; those with a stride keep rate 1.

    Raises ValueError naming the holes of a pattern that leaves some.
    """
    free = [conv for conv in _convolutions(stage) if conv.stride == (1, 1)]
    for conv, rate in zip(free, cycle(pattern, len(free)), strict=True):
        conv.dilation = conv.padding = (rate, rate)


def load_weights(
    backbone: StagedBackbone, source: str, state: dict[str, Tensor], name: str
) -> None:
    """Fill a backbone with a state dict; what it has no place for (a classifier) is passed over.

    source: where it came from; name: what it should be. Raises ValueError naming source and the
    first tensor that does not fit.
    """
    own = backbone.state_dict()
    for key in (key for key in own if not key.endswith("num_batches_tracked")):
        if key not in state:
            raise ValueError(f"{source}: no tensor {key}; these are not {name} weights")
        if state[key].shape != own[key].shape:
            raise ValueError(
                f"{source}: {key} is {list(state[key].shape)}, the backbone's {list(own[key].shape)}"
            )
    backbone.load_state_dict(
        {key: value for key, value in state.items() if key in own}, strict=False
    )


def read_weights(weights: str, model: str | None) -> dict[str, Tensor]:
    """Read a state dict: a file that `torch.save` wrote, or torchvision's weights of that name for
    its model.

    Raises FileNotFoundError when there is no such file and no such name, or the download fails;
    model is None where nothing is published. Raises ValueError when the file holds no state dict.
    """
    if Path(weights).is_file():
        return _read_state_dict(Path(weights))
    published = {} if model is None else get_model_weights(model).__members__
    if weights in published:
        try:
            fetched: dict[str, Tensor] = published[weights].get_state_dict(progress=True)
        except (
            OSError,
            RuntimeError,
        ) as error:  # no network, or a file that is not the published one
            reason = " ".join(str(error).split())
            raise FileNotFoundError(
                f"{weights} of {model}: the download of {published[weights].url} failed ({reason}); give a local file "
                "with --pretrained FILE.pth, or start from random weights with --pretrained none"
            ) from error
        return fetched
    names = (
        f"torchvision's {model} weights are {', '.join(published)}"
        if model
        else "torchvision publishes none"
    )
    raise FileNotFoundError(f"{weights}: no such file, and {names}")


def _read_state_dict(path: Path) -> dict[str, Tensor]:
    """Read the tensors of a file that `torch.save` wrote. Raises ValueError naming the file when it
    is none.
    """
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, ValueError, RuntimeError, pickle.UnpicklingError) as error:
        raise ValueError(
            f"{path}: not a file of torch weights: {str(error).partition(chr(10))[0]}"
        ) from error
    if not isinstance(stored, dict) or not all(torch.is_tensor(value) for value in stored.values()):
        raise ValueError(f"{path}: not a state dict of a backbone, which holds tensors only")
    return dict(stored)


def _convolutions(stage: Sequence[nn.Module]) -> list[nn.Conv2d]:
    found = (m for module in stage for m in module.modules())
    return [m for m in found if isinstance(m, nn.Conv2d) and m.kernel_size == (3, 3)]
