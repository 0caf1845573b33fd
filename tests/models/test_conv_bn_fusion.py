"""The copy that validation runs: equal detections, no norm left, and the network unchanged."""

import copy

import pytest
import torch
from torch import nn
from torchvision.ops import FrozenBatchNorm2d

from cohdc_train.models import MaskRCNN, NetworkConfig, detect, fuse_conv_bn
from cohdc_train.models.frozen_norm import (
    FoldingConv2d,
    FrozenNorm,
    conv_bn_pairs,
    plain_convolution,
)

SHAPES = {
    "resnet18": {"depth": 18, "width": 0.25},
    "resnet50": {"depth": 50, "width": 0.25},
    "mobilenet_v1": {"backbone": "mobilenet_v1", "width": 0.25},
    "mobilenet_v2": {"backbone": "mobilenet_v2", "width": 0.25},
}


def network_of(shape, norm):
    torch.manual_seed(0)
    small = {
        "canvas": (96, 128),
        "fpn_channels": 16,
        "fc": 32,
        "proposals": (50, 20),
        "detections": 10,
    }
    head_norm = "batch" if shape == "resnet50" else "none"
    network = MaskRCNN(
        3,
        NetworkConfig(
            **SHAPES[shape], **small, norm=norm, head_norm=head_norm, score_threshold=0.0
        ),
    ).eval()
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d | FrozenNorm):
            module.running_mean.uniform_(-0.5, 0.5)
            module.running_var.uniform_(0.5, 2.0)
            module.weight.data.uniform_(0.5, 1.5)
            module.bias.data.uniform_(-0.5, 0.5)
    return network


@pytest.mark.parametrize("norm", ["batch", "frozen"])
@pytest.mark.parametrize("shape", SHAPES)
def test_fused_network_detects_the_same(shape, norm):
    network = network_of(shape, norm)
    images = [
        torch.randint(0, 256, (3, 90, 120), dtype=torch.uint8),
        torch.zeros((3, 40, 90), dtype=torch.uint8),
    ]
    for ours, theirs in zip(
        detect(fuse_conv_bn(network), images), detect(network, images), strict=True
    ):
        assert len(theirs["boxes"]) > 0
        for name in theirs:
            torch.testing.assert_close(ours[name], theirs[name], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("shape", SHAPES)
def test_bfloat16_weights_equal_autocast(shape):
    network = network_of(shape, "batch")
    images = [torch.randint(0, 256, (3, 90, 120), dtype=torch.uint8)]
    with torch.autocast("cpu", torch.bfloat16):
        (ours,) = detect(fuse_conv_bn(network, torch.bfloat16), images)
        (theirs,) = detect(fuse_conv_bn(network), images)
    assert len(theirs["boxes"]) > 0
    for name in theirs:
        assert torch.equal(ours[name], theirs[name])


@pytest.mark.parametrize("shape", SHAPES)
def test_all_norms_are_folded_and_the_network_is_unchanged(shape):
    network = network_of(shape, "batch")
    before = {name: value.clone() for name, value in network.state_dict().items()}
    copied = fuse_conv_bn(network)
    assert not [m for m in copied.modules() if isinstance(m, nn.BatchNorm2d | FrozenNorm)]
    assert not any(parameter.requires_grad for parameter in copied.parameters())
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


@pytest.mark.parametrize("shape", SHAPES)
def test_frozen_norms_are_applied_by_the_convolutions_with_equal_gradients(shape):
    network = network_of(shape, "frozen").backbone.body.train()
    reference = copy.deepcopy(network)
    for module, name, norm_name in list(conv_bn_pairs(reference)):
        plain_convolution(getattr(module, name))
        norm = FrozenBatchNorm2d(
            getattr(module, norm_name).weight.numel(), getattr(module, norm_name).eps
        )
        norm.load_state_dict(getattr(module, norm_name).state_dict())
        setattr(module, norm_name, norm)
    assert any(isinstance(module, FoldingConv2d) for module in network.modules())
    assert list(network.state_dict()) == list(reference.state_dict())

    image = torch.rand(1, 3, 64, 96)
    ours, theirs = network(image)["3"], reference(image)["3"]
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)
    ours.square().mean().backward()
    theirs.square().mean().backward()
    for (name, parameter), other in zip(
        network.named_parameters(), reference.parameters(), strict=True
    ):
        torch.testing.assert_close(parameter.grad, other.grad, rtol=1e-3, atol=1e-4, msg=name)
