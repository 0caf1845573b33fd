"""Training samples: images on the canvas, pasted objects, and the visible part of every mask."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset
from torchvision.ops import roi_align

from cohdc_train.data.annotations import CocoImage, CocoObject, read_image
from cohdc_train.data.transforms import Augmentation, Placement, mask_boxes

Target = dict[str, Any]
_MAX_PASTED = 8  # objects of one image that are pasted into another
_MIN_VISIBLE = 0.1  # visible share below which an occluded object is ignored


@dataclass(frozen=True)
class _Scene:
    """Image on the canvas with its objects.

    Objects are made one at a time, so that memory holds one mask of the image's size, however many
    a large image has.

    Attributes:
        image: uint8 [3, H, W] on the canvas.
        size: (height, width) of its content, px.
        ignore: [k, 4] xyxy, px.
        objects: labels, and masks uint8 [H, W].
    """

    image: Tensor
    size: tuple[int, int]
    ignore: Tensor
    objects: Iterable[tuple[int, Tensor]]


class CocoTrainDataset(Dataset[tuple[Tensor, Target]]):
    """Augmented training images on the canvas, with boxes of the visible part of each mask.

    Args:
        images: of every root.
        canvas: (height, width), px.
        augment: augmentation of the images.
        mini_mask: (height, width) in cells at which each mask is kept, on its box, instead of on
            the canvas.
        paste_sources: images whose objects are pasted; `images` when not given.
    """

    def __init__(
        self,
        images: Sequence[CocoImage],
        canvas: tuple[int, int],
        augment: Augmentation,
        mini_mask: tuple[int, int] | None = None,
        paste_sources: Sequence[CocoImage] | None = None,
    ) -> None:
        """Take images that were checked before."""
        self.images = images
        self.paste_sources = paste_sources or images
        self.canvas = canvas
        self.augment = augment
        self.mini_mask = mini_mask

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.images)

    def __getitem__(self, index: int) -> tuple[Tensor, Target]:
        """Return uint8 [3, H, W] and its target.

        Raises:
            DataError: an image cannot be read; the message names it.
        """
        image = self.images[index]
        scene = self._place(image, [o for o in image.objects if not o.crowd])
        if self.augment.copy_paste > 0 and torch.rand(()) < self.augment.copy_paste:
            scene = self._paste(
                self.paste_sources[int(torch.randint(len(self.paste_sources), ()))], scene
            )
        return scene.image, self._target(scene, image.id)

    def _place(self, image: CocoImage, objects: Sequence[CocoObject]) -> _Scene:
        """Place an image and some of its objects on the canvas, at random."""
        size = (image.height, image.width)
        placement = Placement.draw(size, self.canvas, self.augment)
        crowd = torch.tensor(
            [o.box for o in image.objects if o.crowd], dtype=torch.float32
        ).reshape(-1, 4)
        crowd[:, 2:] += crowd[:, :2]
        pixels = placement.image(torch.from_numpy(read_image(image)).permute(2, 0, 1))
        masks = ((o.label, placement.mask(torch.from_numpy(o.mask(*size)))) for o in objects)
        return _Scene(pixels, placement.size, placement.boxes(crowd), masks)

    def _paste(self, source: CocoImage, scene: _Scene) -> _Scene:
        """Paste some objects of another image over the scene (Ghiasi et al. 2021, copy-paste)."""
        whole = [o for o in source.objects if not o.crowd]
        order = torch.randperm(len(whole))[: int(torch.randint(1, _MAX_PASTED + 1, ()))]
        given = self._place(source, [whole[i] for i in order])
        height, width = scene.size
        objects = []
        occluder = torch.zeros(self.canvas, dtype=torch.bool)
        for label, mask in given.objects:
            mask[height:], mask[:, width:] = 0, 0
            objects.append((label, mask))
            occluder |= mask > 0
        hidden: list[Tensor] = []
        behind = list(_occlude(scene.objects, occluder, hidden))
        ignore = torch.cat(
            [scene.ignore, mask_boxes(torch.stack(hidden)) if hidden else scene.ignore[:0]]
        )
        image = torch.where(occluder, given.image, scene.image)
        return replace(scene, image=image, ignore=ignore, objects=behind + objects)

    def _target(self, scene: _Scene, image_id: int) -> Target:
        """Return the target: objects with a visible pixel, and crowd boxes with an area."""
        labels: list[int] = []
        mask_size = self.mini_mask or self.canvas
        masks = [torch.zeros((0, *mask_size), dtype=torch.uint8)]
        boxes = [torch.zeros((0, 4))]
        for label, mask in scene.objects:
            box = mask_boxes(mask[None])
            is_visible = bool(box[0, 2] > box[0, 0])
            if is_visible:
                labels.append(label)
                masks.append(self._kept_mask(mask, box))
                boxes.append(box)
        ignore = scene.ignore
        target = {
            "boxes": torch.cat(boxes),
            "labels": torch.tensor(labels, dtype=torch.int64),
            "masks": torch.cat(masks),
            "ignore": ignore[(ignore[:, 2] > ignore[:, 0]) & (ignore[:, 3] > ignore[:, 1])],
            "image_id": image_id,
            "size": scene.size,
        }
        return target if self.mini_mask is None else target | {"frames": target["boxes"]}

    def _kept_mask(self, mask: Tensor, box: Tensor) -> Tensor:
        """Return a mask [H, W] as it is kept: [1, H, W] whole, or [1, h, w] on its box."""
        if self.mini_mask is None:
            return mask[None]
        return _make_mini_mask(mask, box, self.mini_mask)


def _occlude(
    objects: Iterable[tuple[int, Tensor]], occluder: Tensor, hidden: list[Tensor]
) -> Iterator[tuple[int, Tensor]]:
    """Yield the visible part of objects behind `occluder`; nearly hidden ones go to `hidden`."""
    for label, mask in objects:
        left = mask * ~occluder
        if left.sum() >= _MIN_VISIBLE * mask.sum():
            yield label, left
        else:
            hidden.append(left)


def _make_mini_mask(mask: Tensor, box: Tensor, size: tuple[int, int]) -> Tensor:
    """Return float16 [1, *size]: the share of each cell of a grid over a box that a mask covers.

    Args:
        mask: [H, W] uint8.
        box: [1, 4] xyxy, px.
        size: (rows, columns) of the grid.
    """
    roi = torch.cat([torch.zeros(1, 1), box], dim=1)
    covered: Tensor = roi_align(
        mask[None, None].float(), roi, size, sampling_ratio=-1, aligned=True
    )
    return covered[0].half()
