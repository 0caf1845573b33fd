"""A network made faster for inference: norms folded into the convolutions before them, weights
channels last.
"""

import copy

import torch
from torch import nn

from cohdc_train.models.frozen_norm import conv_norm_pairs, fold_batch_norm
from cohdc_train.models.mask_rcnn import MaskRCNN


def fused(network: MaskRCNN, dtype: torch.dtype | None = None) -> MaskRCNN:
    """A copy in evaluation mode that finds the same detections within rounding, and cannot be
    trained.

    A norm is folded into a convolution where its module names the two one after the other, as every
    backbone and the pyramid here do. Weights are laid out as [out, kernel, kernel, in]; images
    follow. dtype: to cast them to, bfloat16 under autocast to it, which would else cast them anew
    for every batch.
    """
    copied = copy.deepcopy(network).eval().requires_grad_(False)
    for module, name, norm_name in list(conv_norm_pairs(copied)):
        setattr(module, name, fold_batch_norm(getattr(module, name), getattr(module, norm_name)))
        setattr(module, norm_name, nn.Identity())
    for module in copied.modules():
        if dtype is not None and isinstance(module, nn.Conv2d | nn.ConvTranspose2d | nn.Linear):
            module.to(dtype)
    return copied.to(memory_format=torch.channels_last)
