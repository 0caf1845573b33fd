"""Ground-truth masks for the losses: masks of the whole canvas, or mini-masks of one object."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor
from torchvision.ops import roi_align


@dataclass(frozen=True)
class GroundTruthMasks:
    """Masks of one image's objects, each a raster over a frame, with no pixel outside of it.

    Attributes:
        rasters: [G, h, w] share of each cell that the object covers, 0..1, of any dtype.
        frames: float32 [G, 4] xyxy, canvas px: what each raster covers; the canvas, or the box of a
            mini-mask.
    """

    rasters: Tensor
    frames: Tensor

    def __post_init__(self) -> None:
        """Check the shapes."""
        if self.rasters.ndim != 3 or self.frames.shape != (len(self.rasters), 4):
            raise ValueError(
                f"rasters {list(self.rasters.shape)} and frames {list(self.frames.shape)} "
                "do not agree"
            )

    @classmethod
    def from_target(cls, target: Mapping[str, Any], chosen: Tensor) -> "GroundTruthMasks":
        """Select objects of a training target.

        A mini-mask gets a ring of empty cells: RoIAlign repeats a raster's last cell just outside
        of it.

        Args:
            target: `masks`, with `frames` when they are mini-masks.
            chosen: [K] indices of objects.
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
        """Return [G, 2] width and height of a raster's cell, canvas px."""
        side = self.frames.new_tensor([self.rasters.shape[2], self.rasters.shape[1]])
        return (self.frames[:, 2:] - self.frames[:, :2]) / side

    def areas(self) -> Tensor:
        """Return [G] areas of the whole objects, px^2."""
        area: Tensor = self.rasters.to(self.frames.dtype).sum(dim=(1, 2)) * self.cells().prod(dim=1)
        return area

    def coverage(
        self, boxes: Tensor, matched: Tensor, size: tuple[int, int], samples: int = 0
    ) -> Tensor:
        """Compute the share of each cell of a grid over a box that the object covers.

        Args:
            boxes: [K, 4] xyxy, canvas px.
            matched: [K] index of each box's object.
            size: (rows, columns) of the grid.
            samples: per cell and axis; 0 takes all cells of the raster that the grid's cell meets.

        Returns:
            [K, rows, columns] in 0..1.
        """
        frames, cells = self.frames[matched], self.cells()[matched].repeat(1, 2)
        rois = (boxes - frames[:, :2].repeat(1, 2)) / cells
        rois = torch.cat([matched[:, None].to(rois.dtype), rois], dim=1)
        rasters = self.rasters[:, None].to(rois.dtype)
        covered: Tensor = roi_align(rasters, rois, size, sampling_ratio=samples or -1, aligned=True)
        return covered[:, 0]
