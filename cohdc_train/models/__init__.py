"""The network: plain torch, no Lightning, no files, no configuration library."""

from cohdc_train.models.config import NetworkConfig
from cohdc_train.models.conv_bn_fusion import fuse_conv_bn
from cohdc_train.models.inference import Detector, detect
from cohdc_train.models.mask_rcnn import MaskRCNN

__all__ = ["Detector", "MaskRCNN", "NetworkConfig", "detect", "fuse_conv_bn"]
