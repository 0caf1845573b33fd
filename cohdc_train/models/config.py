"""Configuration of the network: backbone, pyramid, heads, and limits of inference."""

from dataclasses import dataclass, replace
from typing import Literal

from cohdc_train.models.backbone import Norm
from cohdc_train.models.cqe_head import Fusion
from cohdc_train.models.cqe_targets import QualityTarget
from cohdc_train.models.mask_head import MaskSize
from cohdc_train.models.resnet import Depth

STRIDES = (4, 8, 16, 32)  # of the backbone's four stages


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of the network; the number of classes comes from the data.

    Attributes:
        backbone: "resnet", "mobilenet_v1" or "mobilenet_v2"; only the first has depths.
        depth: ResNet of 18, 34, 50 or 101 layers.
        width: channels of the backbone as a share of ResNet's.
        rates: dilation patterns of the four stages.
        weights: torchvision name or local path of ImageNet weights for the backbone; None trains
            from scratch.
        norm: of the backbone, and "batch" of the pyramid too: "batch" trains BatchNorm, "frozen"
            keeps the statistics of the initial weights, "auto" is "frozen" with initial weights and
            "batch" without.
        head_norm: "batch" trains BatchNorm in the pyramid and the mask head whatever the backbone
            has; exported, it costs nothing.
        frozen_stages: how many of the stem and the four stages are not trained; None is 2 with
            initial weights, as in torchvision, and 0 without.
        canvas: (height, width) in px every image is fitted into.
        finest_stride: of the pyramid: 4, or 8 without the level that costs most and sees the
            smallest objects.
        anchor_scales: side of the anchors in px, one per pyramid level from the finest; one more
            adds the pool level.
        fpn_channels: width of the pyramid, and of the RPN and mask heads.
        fc: width of the box and CQE heads' fully connected layers.
        cqe: how the CQE head joins feature and mask ("concat", "multiply", "add"); "off" is a
            network without the head, whose quality is 1.
        cqe_target: what the CQE head regresses: mask IoU ("iou"), (1 + CIoU) / 2 ("ciou", the
            paper's S_iou), Boundary IoU ("boundary_iou"), or the smaller of it and mask IoU
            ("min").
        mask_size: side of the predicted masks, cells: 28, or 56 by one more deconvolution.
        mask_cut: what a mask's 0.5 stands for at inference: as likely as not ("half"), or the cut
            of the greatest expected IoU by CQE's estimate of it ("quality",
            `inference.cut_by_quality`).
        proposals: proposals kept per image in training and at inference.
        rois: proposals per image that train the box head, a quarter of them positive.
        detections: rows of the padded output.
        score_threshold: detections at or below it are dropped.
        nms_iou: overlap from which the weaker of two detections of a class is dropped.
    """

    backbone: Literal["resnet", "mobilenet_v1", "mobilenet_v2"] = "resnet"
    depth: Depth = 50
    width: float = 1.0
    rates: tuple[tuple[int, ...], ...] = ((1, 2, 3), (1, 2, 3), (1, 2, 3), (1, 2, 3))
    weights: str | None = None
    norm: Norm | Literal["auto"] = "auto"
    head_norm: Literal["none", "batch"] = "none"
    frozen_stages: int | None = None
    canvas: tuple[int, int] = (800, 1024)
    finest_stride: Literal[4, 8] = 4
    anchor_scales: tuple[int, ...] = (32, 64, 128, 256)
    fpn_channels: int = 256
    fc: int = 1024
    cqe: Fusion | Literal["off"] = "concat"
    cqe_target: QualityTarget = "iou"
    mask_size: MaskSize = 28
    mask_cut: Literal["half", "quality"] = "half"
    proposals: tuple[int, int] = (1000, 300)
    rois: int = 256
    detections: int = 100
    score_threshold: float = 0.05
    nms_iou: float = 0.5

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: a value is out of range, or two of them contradict each other.
        """
        levels, scales = len(self.roi_strides()), len(self.anchor_scales)
        if scales not in (levels, levels + 1):
            raise ValueError(
                f"anchor_scales {self.anchor_scales}: "
                f"{scales} scales for {levels} or {levels + 1} levels"
            )
        if self.frozen_stages is not None and not 0 <= self.frozen_stages <= 5:
            raise ValueError(
                f"frozen_stages {self.frozen_stages}: a ResNet has a stem and 4 stages"
            )
        if self.mask_cut == "quality" and (self.cqe == "off" or self.cqe_target != "iou"):
            raise ValueError("mask_cut quality needs a CQE head that estimates the mask's IoU")
        if self.weights is not None and self.width != 1.0:
            raise ValueError(
                f"weights {self.weights} are of full width, the backbone of width {self.width}"
            )

    def resolved(self, pretrained: bool) -> "NetworkConfig":
        """Return a copy in which norm and frozen_stages are decided.

        Args:
            pretrained: whether training starts from trained weights of the backbone, of this config
                or elsewhere.
        """
        norm: Norm = ("frozen" if pretrained else "batch") if self.norm == "auto" else self.norm
        frozen = (2 if pretrained else 0) if self.frozen_stages is None else self.frozen_stages
        return replace(self, norm=norm, frozen_stages=frozen)

    def roi_strides(self) -> list[int]:
        """Return the strides of the pyramid's levels, without the pool level."""
        return [stride for stride in STRIDES if stride >= self.finest_stride]

    def roi_levels(self) -> list[str]:
        """Return the names of the pyramid's levels, without the pool level."""
        return [str(STRIDES.index(stride)) for stride in self.roi_strides()]
