"""Fixtures: a small network whose random weights detect something."""

import os

# Before numpy and torch are loaded: the processes of pytest share the cores, one thread each.
os.environ["OMP_NUM_THREADS"] = "1"

import pytest
import torch
from hypothesis import settings

from cohdc_train.models import MaskRCNN, NetworkConfig

settings.register_profile("patient", deadline=None)  # a busy machine is no failure
settings.load_profile("patient")

SMALL = NetworkConfig(
    depth=18,
    width=0.25,
    canvas=(96, 128),
    fpn_channels=16,
    fc=32,
    proposals=(100, 50),
    rois=32,
    detections=10,
    anchor_scales=(16, 32, 64, 128),
    score_threshold=0.45,
)


@pytest.fixture(scope="session")
def opinionated():
    """Make a network with random weights, scaled until its outputs vary and do not saturate."""
    torch.manual_seed(0)
    network = MaskRCNN(2, SMALL).eval()
    with torch.no_grad():
        network.rpn.head.cls_logits.weight.mul_(3)
        network.rpn.head.bbox_pred.weight.mul_(10)
        network.roi_heads.mask_predictor.mask_fcn_logits.weight.mul_(5)
    return network


@pytest.fixture
def small_config():
    """Return the configuration of the small network."""
    return SMALL
