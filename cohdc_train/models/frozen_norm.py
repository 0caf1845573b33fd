"""Frozen norms, and convolutions that apply them through their own weights."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval
from torchvision.ops import FrozenBatchNorm2d


class FrozenNorm(FrozenBatchNorm2d):  # type: ignore[misc]  # torchvision is not typed
    """BatchNorm whose statistics, scale and shift are constants.

    Torchvision's makes two passes over the map, and turns it into float32 in mixed precision; this
    class makes one.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Normalize x [B, C, H, W]; shape and dtype stay."""
        return F.batch_norm(
            x, self.running_mean, self.running_var, self.weight, self.bias, eps=self.eps
        )


class AppliedNorm(FrozenNorm):
    """Frozen norm that the convolution before it has applied already; returns its input."""

    def forward(self, x: Tensor) -> Tensor:
        """Return x."""
        return x


class FoldingConv2d(nn.Conv2d):
    """Convolution that applies the frozen norm behind it: its weights are scaled before each pass.

    That costs nothing compared with a pass over the map, and the weights and the norm keep their
    names and values.
    """

    norms: list[FrozenNorm]  # one norm, in a list, so that it is no submodule here

    def forward(self, x: Tensor) -> Tensor:
        """Convolve and normalize x [B, C, H, W]."""
        norm = self.norms[0]
        scale = norm.weight * (norm.running_var + norm.eps).rsqrt()
        shift = norm.bias - norm.running_mean * scale
        bias = shift if self.bias is None else shift + self.bias * scale
        weight = self.weight * scale[:, None, None, None]
        return F.conv2d(x, weight, bias, self.stride, self.padding, self.dilation, self.groups)


def conv_bn_pairs(network: nn.Module) -> Iterator[tuple[nn.Module, str, str]]:
    """Yield each convolution with a norm behind it: the module that has both, and their names."""
    for module in network.modules():
        for (name, first), (norm_name, second) in pairwise(module.named_children()):
            if isinstance(first, nn.Conv2d) and hasattr(second, "running_mean"):
                yield module, name, norm_name


def apply_norms_in_convolutions(network: nn.Module) -> None:
    """Make each convolution with a frozen norm behind it apply that norm itself, in place."""
    for module, name, norm_name in conv_bn_pairs(network):
        convolution, norm = getattr(module, name), getattr(module, norm_name)
        if isinstance(norm, FrozenNorm):
            convolution.__class__ = FoldingConv2d
            convolution.norms = [norm]
            norm.__class__ = AppliedNorm


def plain_convolution(convolution: nn.Conv2d) -> nn.Conv2d:
    """Turn a convolution in place into one that applies no norm, and return it."""
    if isinstance(convolution, FoldingConv2d):
        del convolution.norms
        convolution.__class__ = nn.Conv2d  # type: ignore[assignment]
    return convolution


def fold_batch_norm(convolution: nn.Conv2d, norm: Any) -> nn.Conv2d:
    """Return a convolution that computes what convolution and norm compute in evaluation mode."""
    return fuse_conv_bn_eval(plain_convolution(convolution), norm)
