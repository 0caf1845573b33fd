"""Geometry of training images on the CPU (torchvision), and photometry on the device (kornia)."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from kornia.augmentation import (
    AugmentationSequential,
    ColorJiggle,
    IntensityAugmentationBase2D,
    RandomGamma,
    RandomGaussianBlur,
    RandomGaussianNoise,
    RandomJPEG,
    RandomLinearIllumination,
    RandomMotionBlur,
    RandomPlanckianJitter,
)
from torch import Tensor
from torchvision import tv_tensors
from torchvision.transforms.v2 import functional as F2  # noqa: N812


@dataclass(frozen=True)
class Augmentation:
    """Augmentation of training images.

    Attributes:
        flip: probability of a horizontal flip.
        scale_jitter: smallest and largest scale, relative to the one at which the image just fits
            into the canvas; drawn per image, it is the multi-scale training.
        copy_paste: probability that objects of another training image are pasted over this one.
        photometric: vary brightness, contrast, color temperature, noise and blur on the device.
        degrade: probability of each fault that a moving camera's image has: gamma, light that
            changes across it (a rolling shutter's exposure), motion blur, noise and JPEG.
    """

    flip: float = 0.5
    scale_jitter: tuple[float, float] = (0.8, 1.25)
    copy_paste: float = 0.0
    photometric: bool = True
    degrade: float = 0.0

    def __post_init__(self) -> None:
        """Raise ValueError for a value that is out of range."""
        low, high = self.scale_jitter
        if not 0 < low <= high:
            raise ValueError(f"scale_jitter {self.scale_jitter}: needs 0 < smallest <= largest")
        for name in ("flip", "copy_paste", "degrade"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} {getattr(self, name)}: a probability is in 0..1")


@dataclass(frozen=True)
class Placement:
    """Place of an image on the canvas: a window of it, scaled into the top left, perhaps mirrored.

    The window is cut before it is resized, so that no pixel is computed that would be thrown away.
    Images are resized bilinearly with antialiasing. Masks take the nearest pixel, center to center
    (v2's own rule for masks is half a pixel off). The rest of the canvas is 0.

    Attributes:
        top: first row of the window, px of the image.
        left: its first column, px of the image.
        height: rows of the window.
        width: columns of the window.
        size: (height, width) in px of the content on the canvas.
        canvas: (height, width) in px.
        mirrored: left and right are swapped.
    """

    top: int
    left: int
    height: int
    width: int
    size: tuple[int, int]
    canvas: tuple[int, int]
    mirrored: bool

    @classmethod
    def draw(
        cls, image: tuple[int, int], canvas: tuple[int, int], augment: Augmentation
    ) -> "Placement":
        """Draw a random placement.

        Args:
            image: (height, width), px.
            canvas: (height, width), px.
            augment: scales and probability of a flip.
        """
        jitter = float(torch.empty(()).uniform_(*augment.scale_jitter))
        scale = min(canvas[0] / image[0], canvas[1] / image[1]) * jitter
        rows = _round_within(canvas[0] / scale, image[0])
        columns = _round_within(canvas[1] / scale, image[1])
        height = _round_within(rows * scale, canvas[0])
        width = _round_within(columns * scale, canvas[1])
        top = int(torch.randint(image[0] - rows + 1, ()))
        left = int(torch.randint(image[1] - columns + 1, ()))
        mirrored = bool(torch.rand(()) < augment.flip)
        return cls(top, left, rows, columns, (height, width), canvas, mirrored)

    def image(self, pixels: Tensor) -> Tensor:
        """Place an image: uint8 [3, H, W] -> uint8 [3, *canvas]."""
        window = (self.top, self.left, self.height, self.width)
        return self._finish(F2.resized_crop(pixels, *window, list(self.size), antialias=True))

    def mask(self, mask: Tensor) -> Tensor:
        """Place a mask of 0 and 1: uint8 [H, W] -> [*canvas]."""
        window = mask[self.top : self.top + self.height, self.left : self.left + self.width]
        return self._finish(
            F.interpolate(window[None, None], self.size, mode="nearest-exact")[0, 0]
        )

    def boxes(self, boxes: Tensor) -> Tensor:
        """Place boxes, clipped to the content: float32 [n, 4] xyxy, px -> px of the canvas.

        Boxes outside the content have no extent.
        """
        image_size = (self.top + self.height, self.left + self.width)
        moved = tv_tensors.BoundingBoxes(boxes, format="XYXY", canvas_size=image_size)
        moved = F2.resized_crop(
            moved, self.top, self.left, self.height, self.width, list(self.size)
        )
        moved = F2.horizontal_flip(moved) if self.mirrored else moved
        clipped: Tensor = F2.clamp_bounding_boxes(moved).as_subclass(Tensor)
        return clipped

    def _finish(self, content: Tensor) -> Tensor:
        flipped = content.flip(-1) if self.mirrored else content
        return F.pad(flipped, (0, self.canvas[1] - self.size[1], 0, self.canvas[0] - self.size[0]))


def _round_within(value: float, largest: int) -> int:
    """Return the nearest whole number in 1..largest."""
    return max(1, min(largest, round(value)))


def mask_boxes(masks: Tensor) -> Tensor:
    """Return the tight boxes of masks [n, H, W]: float32 [n, 4] xyxy, px; 0 where one is empty.

    x1 and y1 are one past the last pixel.
    """
    columns, rows = masks.amax(dim=1) > 0, masks.amax(dim=2) > 0
    edges = []
    for line in (columns, rows):
        first = line.int().argmax(dim=1)
        past = (line.shape[1] - line.flip(1).int().argmax(dim=1)) * line.any(dim=1)
        edges.append((first, past))
    (x0, x1), (y0, y1) = edges
    return torch.stack([x0, y0, x1, y1], dim=1).float()


def photometric_augmentation(augment: Augmentation) -> AugmentationSequential | None:
    """Return the augmentation of color and of a camera's faults, drawn per image; None for none.

    It takes float images [B, 3, H, W] in 0..1. Color varies by the temperature of the light: hue
    and saturation, through HSV, cost five times as much as the rest.
    """
    steps: list[IntensityAugmentationBase2D] = []
    if augment.photometric:
        steps += [
            ColorJiggle(brightness=(0.6, 1.4), contrast=(0.7, 1.3), p=0.8),
            RandomPlanckianJitter(p=0.3),
            RandomGaussianNoise(std=0.02, p=0.2),
            RandomGaussianBlur((3, 3), (0.3, 1.0), p=0.1),
        ]
    if augment.degrade > 0:
        p = augment.degrade
        steps += [
            RandomGamma((0.6, 1.7), p=p),
            RandomLinearIllumination(gain=(0.05, 0.3), p=p),
            RandomMotionBlur((3, 11), angle=180.0, direction=0.0, border_type="replicate", p=p),
            RandomGaussianNoise(std=0.05, p=p),
            RandomJPEG((20.0, 80.0), p=p),
        ]
    return AugmentationSequential(*steps, data_keys=["input"]) if steps else None


def blank_padding(images: Tensor, sizes: list[tuple[int, int]]) -> Tensor:
    """Set images [B, 3, H, W] to 0, in place, outside the (height, width) of their content."""
    for image, (height, width) in zip(images, sizes, strict=True):
        image[:, height:] = 0
        image[:, :, width:] = 0
    return images
