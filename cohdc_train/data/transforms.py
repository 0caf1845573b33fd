"""Training geometry on the CPU (torchvision.transforms.v2) and photometry on the device (kornia)."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from kornia.augmentation import (
    AugmentationSequential,
    ColorJiggle,
    RandomGaussianBlur,
    RandomGaussianNoise,
    RandomPlanckianJitter,
)
from torch import Tensor
from torchvision import tv_tensors
from torchvision.transforms import v2
from torchvision.transforms.v2.functional import get_size, pad, resized_crop


@dataclass(frozen=True)
class Augmentation:
    """What training images go through.

    Attributes:
        flip: probability of a horizontal flip.
        scale_jitter: smallest and largest scale, relative to the one at which the image just fits into the canvas.
        photometric: vary brightness, contrast, colour temperature, noise and blur on the device.
    """

    flip: float = 0.5
    scale_jitter: tuple[float, float] = (0.5, 1.5)
    photometric: bool = True

    def __post_init__(self) -> None:
        low, high = self.scale_jitter
        if not 0 < low <= high:
            raise ValueError(f"scale_jitter {self.scale_jitter}: needs 0 < smallest <= largest")


class JitteredCrop(v2.Transform):  # type: ignore[misc]  # torchvision is not typed
    """Scale an image at random and, where it is larger than the canvas, keep a random window of the canvas' size.

    The window is cut before it is resized, so that no pixel is computed that would be thrown away. Images are resized
    bilinearly with antialiasing; masks take the nearest pixel, centre to centre (v2's own rule for masks is half a
    pixel off).
    """

    def __init__(self, canvas: tuple[int, int], jitter: tuple[float, float]) -> None:
        super().__init__()
        self.canvas = canvas
        self.jitter = jitter

    def make_params(self, flat_inputs: list[Any]) -> dict[str, Any]:
        """The window (top, left, height, width in image px) and its size on the canvas."""
        height, width = get_size(next(x for x in flat_inputs if isinstance(x, tv_tensors.Image)))
        scale = min(self.canvas[0] / height, self.canvas[1] / width) * float(torch.empty(()).uniform_(*self.jitter))
        rows, columns = (max(1, min(n, round(c / scale))) for n, c in zip((height, width), self.canvas, strict=True))
        size = [max(1, min(c, round(n * scale))) for n, c in zip((rows, columns), self.canvas, strict=True)]
        top, left = int(torch.randint(height - rows + 1, ())), int(torch.randint(width - columns + 1, ()))
        return {"top": top, "left": left, "height": rows, "width": columns, "size": size}

    def transform(self, inpt: Any, params: dict[str, Any]) -> Any:
        """One image, mask or box tensor through the window."""
        if not isinstance(inpt, tv_tensors.Mask):
            return resized_crop(inpt, **params, antialias=True)
        bottom, right = params["top"] + params["height"], params["left"] + params["width"]
        window = inpt.as_subclass(Tensor)[:, params["top"] : bottom, params["left"] : right]
        return tv_tensors.Mask(F.interpolate(window[None], params["size"], mode="nearest-exact")[0])


class PadToCanvas(v2.Transform):  # type: ignore[misc]
    """Zeros at the right and at the bottom up to the canvas."""

    def __init__(self, canvas: tuple[int, int]) -> None:
        super().__init__()
        self.canvas = canvas

    def make_params(self, flat_inputs: list[Any]) -> dict[str, Any]:
        """The padding: left, top, right, bottom."""
        height, width = get_size(next(x for x in flat_inputs if isinstance(x, tv_tensors.Image)))
        return {"padding": [0, 0, self.canvas[1] - width, self.canvas[0] - height]}

    def transform(self, inpt: Any, params: dict[str, Any]) -> Any:
        """One image, mask or box tensor, padded."""
        return pad(inpt, **params)


class TrainingTransform:
    """Scale jitter with crop, horizontal flip, padding to the canvas; boxes are clamped to what is left of them."""

    def __init__(self, canvas: tuple[int, int], augment: Augmentation) -> None:
        self._crop = JitteredCrop(canvas, augment.scale_jitter)
        self._rest = v2.Compose(
            [v2.RandomHorizontalFlip(augment.flip), v2.ClampBoundingBoxes(), PadToCanvas(canvas)],
        )

    def __call__(self, sample: dict[str, Any], masks: Iterable[Tensor]) -> dict[str, Any]:
        """A sample on the canvas, with `masks` [n, H, W] in it.

        sample: an `image` and whatever boxes and masks belong to it; masks: of the image's size, [height, width] each,
        taken one at a time, so that however many objects a large image has, one mask of its size is in memory.
        """
        params = self._crop.make_params([sample["image"]])
        out = {name: self._crop.transform(value, params) for name, value in sample.items()}
        cut = [self._crop.transform(tv_tensors.Mask(mask[None]), params) for mask in masks]
        none = tv_tensors.Mask(torch.zeros((0, *params["size"]), dtype=torch.uint8))
        out["masks"] = tv_tensors.Mask(torch.cat(cut)) if cut else none
        result: dict[str, Any] = self._rest(out)
        return result


def mask_boxes(masks: Tensor) -> Tensor:
    """Tight boxes of masks: [n, H, W] -> float32 [n, 4] xyxy, px, x1 and y1 one past the last pixel; 0 where empty."""
    columns, rows = masks.amax(dim=1) > 0, masks.amax(dim=2) > 0
    edges = []
    for line in (columns, rows):
        first = line.int().argmax(dim=1)
        past = (line.shape[1] - line.flip(1).int().argmax(dim=1)) * line.any(dim=1)
        edges.append((first, past))
    (x0, x1), (y0, y1) = edges
    return torch.stack([x0, y0, x1, y1], dim=1).float()


def photometric_augmentation() -> AugmentationSequential:
    """Colour, noise and blur for float images [B, 3, H, W] in 0..1, drawn per image.

    Colour varies by the temperature of the light: hue and saturation, through HSV, cost five times as much as the rest.
    """
    return AugmentationSequential(
        ColorJiggle(brightness=(0.6, 1.4), contrast=(0.7, 1.3), p=0.8),
        RandomPlanckianJitter(p=0.3),
        RandomGaussianNoise(std=0.02, p=0.2),
        RandomGaussianBlur((3, 3), (0.3, 1.0), p=0.1),
        data_keys=["input"],
    )


def blank_padding(images: Tensor, sizes: list[tuple[int, int]]) -> Tensor:
    """Images [B, 3, H, W] with zeros, in place, outside the (height, width) that each image's content takes."""
    for image, (height, width) in zip(images, sizes, strict=True):
        image[:, height:] = 0
        image[:, :, width:] = 0
    return images
