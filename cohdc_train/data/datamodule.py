"""Turn COCO-format folders into batches for the trainer."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import cv2
import lightning.pytorch as pl
import torch
from kornia.augmentation import IntensityAugmentationBase2D
from lightning.pytorch.utilities import rank_zero_info
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from cohdc_train.data import image_files
from cohdc_train.data.annotations import CocoImage, read_image
from cohdc_train.data.canvas import choose_canvas
from cohdc_train.data.coco import CocoFolder, CocoSplit, read_folder, read_split
from cohdc_train.data.layout import CocoPaths, find_split
from cohdc_train.data.train_dataset import CocoTrainDataset, Target
from cohdc_train.data.transforms import Augmentation, blank_padding, photometric_augmentation
from cohdc_train.errors import DataError

ValSample = tuple[Tensor, int]
_AUGMENTATION = Augmentation()


@dataclass(frozen=True)
class Subset:
    """Number of images to use of each split, drawn at random, always the same ones. None uses all.

    Attributes:
        train: training images of every root.
        val: validation images.
    """

    train: int | None = None
    val: int | None = None


_ALL_IMAGES = Subset()


class TrainBatch(NamedTuple):
    """One training batch.

    Attributes:
        images: [B, 3, H, W] on the canvas; uint8 from the loader, float32 in 0..1 on the device.
        targets: per image `boxes` [n, 4] xyxy px, `labels` int64 [n] from 1, `masks` uint8 [n, H,
            W], `ignore` [k, 4] boxes of crowds, `image_id`, and `size`: (height, width) of the
            content on the canvas; the rest is padding. With mini-masks `masks` are float16 [n, h,
            w] on `frames` [n, 4], the boxes.
    """

    images: Tensor
    targets: list[Target]


class CocoValDataset(Dataset[ValSample]):
    """Validation images as they are on disk."""

    def __init__(self, split: CocoSplit) -> None:
        """Take the images of a split."""
        self.split = split

    def __len__(self) -> int:
        """Return the number of images."""
        return len(self.split.images)

    def __getitem__(self, index: int) -> ValSample:
        """Return uint8 [3, height, width] RGB at the image's own size, and the image id."""
        image = self.split.images[index]
        return torch.from_numpy(read_image(image)).permute(2, 0, 1).contiguous(), image.id


class CocoDataModule(pl.LightningDataModule):
    """Training and validation batches from COCO-format folders of any usual layout.

    Validation uses the first root's val split. Several roots train together when they have the same
    class names after the filter; their ids may differ.

    Args:
        root: the folder, or several.
        classes: use these classes only; None uses all of them.
        canvas: (height, width) in px that every training image is fitted into; the network uses the
            same. "auto" chooses it from the images, at most 480 x 640 px in area.
        batch_size: images per batch and device; `cohdc fit` also takes "auto", the most that memory
            allows.
        workers: processes that read images; 0 reads them in the trainer's own.
        augment: augmentation of training images.
        mini_mask: (height, width) in cells at which each training mask is kept, on its box: less
            memory for many objects, softer contours for large ones. None keeps whole masks.
        subset: number of images to use of each split.
        overfit: train on so many training images, without augmentation, and validate on the same
            ones: a check that the labels can be learned at all. 0 is a normal training.
        paste_roots: folders of the same classes whose training objects are pasted into the images
            of `root`, but whose images are not trained on; needs `augment.copy_paste`.
        paths: annotation files and image folders, where the layout is an unusual one.

    Raises:
        DataError: an annotation file or an image cannot be used; one line names it.
    """

    def __init__(
        self,
        root: list[Path] | Path | None = None,
        classes: list[str] | None = None,
        canvas: tuple[int, int] | Literal["auto"] = "auto",
        batch_size: int | Literal["auto"] = 2,
        workers: int = 1,
        augment: Augmentation = _AUGMENTATION,
        mini_mask: tuple[int, int] | None = None,
        subset: Subset = _ALL_IMAGES,
        overfit: int = 0,
        paste_roots: list[Path] | None = None,
        paths: CocoPaths | None = None,
    ) -> None:
        """Check the options. Files are read at the first use."""
        super().__init__()
        roots = root if isinstance(root, list) else [] if root is None else [root]
        self.roots = [Path(folder) for folder in roots]
        self.classes = classes
        self._canvas = canvas
        self.batch_size = batch_size
        self.workers = workers
        self.augment = augment
        self.mini_mask = mini_mask
        self.subset = subset
        if overfit < 0:
            raise DataError(f"overfit {overfit}: the number of images is not negative")
        self.overfit = overfit
        if overfit:
            self.augment = augment = Augmentation(
                flip=0.0, scale_jitter=(1.0, 1.0), photometric=False
            )
        self.paste_roots = paste_roots or []
        if self.paste_roots and not augment.copy_paste:
            fix = "give data.augment.copy_paste, a probability"
            raise DataError(f"data.paste_roots are pasted nowhere: {fix}")
        self.paths = paths
        self._folder: CocoFolder | None = None
        self._photometric = photometric_augmentation(augment)

    @property
    def folder(self) -> CocoFolder:
        """Checked annotations, read at the first use."""
        if self._folder is None:
            whole = read_folder(self.roots, self.classes, self.paths)
            train = tuple(split.subset(self.subset.train) for split in whole.train)
            self._folder = CocoFolder(train, whole.val.subset(self.subset.val))
            if self.overfit:
                usable = train[0].without_empty_images()
                num_usable = len(usable.images)
                if self.overfit > num_usable:
                    raise DataError(
                        f"--overfit {self.overfit}: {usable.annotations} has {num_usable} training "
                        f"images with objects; give at most {num_usable}"
                    )
                same = usable.subset(self.overfit)
                self._folder = CocoFolder((same,), same)
        return self._folder

    @property
    def canvas(self) -> tuple[int, int]:
        """Size (height, width), px, that training images are fitted into."""
        if self._canvas == "auto":
            images = _images(self.folder.train)
            self._canvas = choose_canvas([(image.height, image.width) for image in images])
        return self._canvas

    @cached_property
    def paste_sources(self) -> tuple[CocoSplit, ...]:
        """Training splits whose objects are pasted: those of `root` and of `paste_roots`."""
        given = [
            read_split("train", find_split(root, "train"), self.classes)
            for root in self.paste_roots
        ]
        return (
            *self.folder.train,
            *(split.with_class_order(self.folder.class_names) for split in given),
        )

    @property
    def class_names(self) -> list[str]:
        """Name of label i + 1 at index i."""
        return list(self.folder.class_names)

    @property
    def num_classes(self) -> int:
        """Number of classes without background."""
        return len(self.folder.class_names)

    def setup(self, stage: str) -> None:
        """Check every image file before the first step, and print what reading annotations skipped.

        Raises:
            DataError: an image is missing, damaged or not of its annotated size; one line names it.
        """
        splits = [self.folder.val, *(self.paste_sources if stage == "fit" else ())]
        for split in splits:
            check_images(split)

    @cached_property
    def val_ground_truth(self) -> dict[str, Any]:
        """Validation split as a COCO dict with category ids 1..C."""
        return self.folder.val.ground_truth()

    def train_dataloader(self) -> DataLoader[Any]:
        """Return shuffled batches of `TrainBatch`. The order and every draw follow torch's seed."""
        images, paste_sources = _images(self.folder.train), _images(self.paste_sources)
        training = CocoTrainDataset(
            images, self.canvas, self.augment, self.mini_mask, paste_sources
        )
        return self._loader(training, shuffle=True, collate=_collate_train)

    def val_dataloader(self) -> DataLoader[Any]:
        """Return batches [(image uint8 [3, height, width], image id), ...]."""
        return self._loader(CocoValDataset(self.folder.val), shuffle=False, collate=list)

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """Return training images as float32 in 0..1, augmented in color; the padding stays 0."""
        if not isinstance(batch, TrainBatch):
            return batch
        images = batch.images.float() / 255
        if self._photometric is not None:
            for step in self._photometric.children():
                # kornia would draw a whole batch of noise on the CPU
                intensity_step = cast(IntensityAugmentationBase2D, step)
                intensity_step.set_rng_device_and_dtype(images.device, images.dtype)
            with torch.autocast(images.device.type, enabled=False):
                images = cast(Tensor, self._photometric(images)).clamp(0, 1)
            images = blank_padding(images, [target["size"] for target in batch.targets])
        return TrainBatch(images, batch.targets)

    def _loader(self, dataset: Dataset[Any], shuffle: bool, collate: Any) -> DataLoader[Any]:
        if self.batch_size == "auto":
            raise DataError("batch_size auto: only `cohdc fit` can find it")
        return DataLoader(
            dataset,
            batch_size=self.batch_size,
            shuffle=shuffle,
            num_workers=self.workers,
            collate_fn=collate,
            worker_init_fn=_init_worker,
            pin_memory=torch.cuda.is_available(),
            persistent_workers=self.workers > 0,
        )


def check_images(split: CocoSplit) -> None:
    """Check every image file of a split, and print what reading its annotations skipped.

    Raises:
        DataError: an image is missing, damaged or not of its annotated size; one line names it.
    """
    if split.reading_report():
        rank_zero_info(split.reading_report())
    for image in split.images:
        image_files.check_image(image.path, image.id, (image.width, image.height))


def _images(splits: Sequence[CocoSplit]) -> list[CocoImage]:
    return [image for split in splits for image in split.images]


def _collate_train(samples: Sequence[tuple[Tensor, Target]]) -> TrainBatch:
    return TrainBatch(
        torch.stack([image for image, _ in samples]), [target for _, target in samples]
    )


def _init_worker(worker: int) -> None:
    cv2.setNumThreads(0)  # threads of OpenCV in every worker would compete for the cores
