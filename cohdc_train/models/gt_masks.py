"""Ground-truth masks as the losses want them: whole masks of the canvas, or mini-masks of one
object each.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor
from torchvision.ops import roi_align


@dataclass(frozen=True)
class TrueMasks:
    """The masks of one image's objects, each a raster over a frame; outside of its frame an object
    has no pixel.

    Attributes:
        rasters: [G, h, w] share of each cell that the object covers, 0..1, of any dtype.
        frames: float32 [G, 4] xyxy, canvas px: what each raster covers; the canvas, or a
            mini-mask's box.
    """

    rasters: Tensor
    frames: Tensor

    def __post_init__(self) -> None:
        if self.rasters.ndim != 3 or self.frames.shape != (len(self.rasters), 4):
            raise ValueError(
                f"rasters {list(self.rasters.shape)} and frames {list(self.frames.shape)} do not agree"
            )

    @classmethod
    def of(cls, target: Mapping[str, Any], chosen: Tensor) -> "TrueMasks":
        """Objects `chosen` [K] of a training target: `masks`, with `frames` when they are
        mini-masks.

        A mini-mask gets a ring of empty cells: RoIAlign repeats a raster's last cell just outside
        of it.
        """
        rasters = target["masks"][chosen]
        if "frames" in target:
            mini = cls(rasters, target["frames"][chosen])
            ring = mini.cells()
            return cls(F.pad(rasters, (1, 1, 1, 1)), mini.frames + torch.cat([-ring, ring], dim=1))
        height, width = rasters.shape[-2:]
        canvas = torch.tensor([0.0, 0.0, width, height], device=rasters.device)
        return cls(rasters, canvas.expand(len(rasters), 4))

    def cells(self) -> Tensor:
        """[G, 2] width and height, in canvas px, of a raster's cell."""
        side = self.frames.new_tensor([self.rasters.shape[2], self.rasters.shape[1]])
        return (self.frames[:, 2:] - self.frames[:, :2]) / side

    def areas(self) -> Tensor:
        """[G] px^2 of the whole objects."""
        area: Tensor = self.rasters.to(self.frames.dtype).sum(dim=(1, 2)) * self.cells().prod(dim=1)
        return area

    def within(
        self, boxes: Tensor, matched: Tensor, size: tuple[int, int], samples: int = 0
    ) -> Tensor:
        """[K, *size]: share of each cell of a grid over its box that the object covers.

        boxes: [K, 4] xyxy, canvas px; matched: [K] index of each box's object; samples: per cell
        and axis, 0 takes every cell of the raster that the grid's cell meets.
        """
        frames, cells = self.frames[matched], self.cells()[matched].repeat(1, 2)
        rois = (boxes - frames[:, :2].repeat(1, 2)) / cells
        rois = torch.cat([matched[:, None].to(rois.dtype), rois], dim=1)
        rasters = self.rasters[:, None].to(rois.dtype)
        covered: Tensor = roi_align(rasters, rois, size, sampling_ratio=samples or -1, aligned=True)
        return covered[:, 0]
