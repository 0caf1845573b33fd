"""The network: plain torch, no Lightning, no files, no configuration library."""

from cohdc_train.models.conv_bn_fusion import fused
from cohdc_train.models.inference import Detector, detect
from cohdc_train.models.mask_rcnn import MaskRCNN, NetworkConfig

__all__ = ["Detector", "MaskRCNN", "NetworkConfig", "detect", "fused"]
