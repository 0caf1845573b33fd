"""Training samples: effect of copy-paste on pixels, masks and boxes, and mini-masks."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from cohdc_train.data.annotations import CocoImage, CocoObject
from cohdc_train.data.train_dataset import CocoTrainDataset
from cohdc_train.data.transforms import Augmentation, mask_boxes

STILL = Augmentation(flip=0.0, scale_jitter=(1.0, 1.0), photometric=False)
PASTING = Augmentation(flip=0.0, scale_jitter=(1.0, 1.0), copy_paste=1.0, photometric=False)
HEIGHT, WIDTH = 60, 80


def rectangle(
    number: int, label: int, box: tuple[int, int, int, int], crowd: bool = False
) -> CocoObject:
    x, y, w, h = box
    outline = [[x, y, x + w, y, x + w, y + h, x, y + h]]
    return CocoObject(number, label, (x, y, w, h), w * h, outline, crowd)


def image(
    folder: Path,
    number: int,
    color: int,
    objects: list[CocoObject],
    size: tuple[int, int] = (HEIGHT, WIDTH),
):
    """Write a gray image with its objects' boxes in its own color."""
    pixels = np.full((*size, 3), 20, dtype=np.uint8)
    for o in objects:
        x, y, w, h = (int(v) for v in o.box)
        pixels[y : y + h, x : x + w] = color
    path = folder / f"{number}.png"
    cv2.imwrite(str(path), pixels)
    return CocoImage(number, path, *size, tuple(objects))


@pytest.fixture
def two(tmp_path: Path) -> list[CocoImage]:
    """Return an image with a large object (label 1), and one with a smaller (label 2).

    The smaller would lie over the middle of the large one.
    """
    behind = image(tmp_path, 1, 100, [rectangle(1, 1, (10, 10, 60, 40))])
    before = image(tmp_path, 2, 200, [rectangle(2, 2, (30, 20, 20, 20))])
    return [behind, before]


def samples(images: list[CocoImage], augment: Augmentation, count: int = 20, **kwargs):
    torch.manual_seed(0)
    return [CocoTrainDataset(images, (HEIGHT, WIDTH), augment, **kwargs)[0] for _ in range(count)]


def test_sample_without_pasting_equals_image(two: list[CocoImage]) -> None:
    pixels, target = samples(two, STILL, 1)[0]
    assert target["boxes"].tolist() == [[10, 10, 70, 50]]
    assert target["size"] == (HEIGHT, WIDTH)
    assert torch.equal(pixels[0] == 100, target["masks"][0] > 0)


def test_pasted_object_hides_what_is_behind_it(two: list[CocoImage]) -> None:
    seen = set()
    for pixels, target in samples(two, PASTING):
        labels = target["labels"].tolist()
        seen.add(tuple(labels))
        for label, mask in zip(labels, target["masks"], strict=True):
            assert torch.equal(mask > 0, pixels[0] == {1: 100, 2: 200}[label])
        assert torch.equal(target["boxes"], mask_boxes(target["masks"]))
        assert int(target["masks"].sum(dim=0).max()) == 1
    assert (1, 2) in seen


def test_nearly_hidden_object_is_ignored(tmp_path: Path) -> None:
    """Its visible rest (4 of 64 rows) is neither an object nor background."""
    small = image(tmp_path, 1, 100, [rectangle(1, 1, (30, 20, 21, 20))])
    large = image(tmp_path, 2, 200, [rectangle(2, 2, (20, 10, 30, 40))])
    pasted = [t for _, t in samples([small, large], PASTING) if t["labels"].tolist() == [2]]
    assert pasted
    for target in pasted:
        assert target["ignore"].tolist() == [[50, 20, 51, 40]]


def test_nothing_is_pasted_into_the_padding(tmp_path: Path) -> None:
    flat = image(tmp_path, 1, 100, [rectangle(1, 1, (2, 2, 10, 10))], size=(30, 80))
    tall = image(tmp_path, 2, 200, [rectangle(2, 2, (20, 10, 30, 45))])
    pasted = [(p, t) for p, t in samples([flat, tall], PASTING) if 2 in t["labels"].tolist()]
    assert pasted
    for pixels, target in pasted:
        assert target["size"] == (30, 80)
        assert not pixels[:, 30:].any()
        assert target["boxes"][-1].tolist() == [20, 10, 50, 30]


def test_paste_source_without_objects_or_with_crowds_changes_nothing(tmp_path: Path) -> None:
    empty = image(tmp_path, 1, 100, [])
    crowd = image(tmp_path, 2, 200, [rectangle(1, 1, (10, 10, 20, 20), crowd=True)])
    for index, expected in ((0, []), (1, [[10, 10, 30, 30]])):
        torch.manual_seed(0)
        _, target = CocoTrainDataset([empty, crowd], (HEIGHT, WIDTH), PASTING)[index]
        assert target["labels"].tolist() == []
        assert target["masks"].shape == (0, HEIGHT, WIDTH)
        assert target["ignore"].tolist() == expected


def test_mini_masks_lie_on_their_boxes(two: list[CocoImage]) -> None:
    _, target = samples(two, STILL, 1, mini_mask=(28, 28))[0]
    assert target["masks"].shape == (1, 28, 28)
    assert target["masks"].dtype == torch.float16
    assert torch.equal(target["frames"], target["boxes"])
    assert (target["masks"][:, 1:-1, 1:-1] == 1).all()
    assert (target["masks"] > 0.85).all()  # half a pixel beyond the edge weighs in
    _, none = CocoTrainDataset(
        [CocoImage(3, two[0].path, HEIGHT, WIDTH, ())], (HEIGHT, WIDTH), STILL, (28, 28)
    )[0]
    assert none["masks"].shape == (0, 28, 28)
    assert none["frames"].shape == (0, 4)


def test_objects_come_only_from_paste_sources(two: list[CocoImage]) -> None:
    pasted = samples(two[:1], PASTING, 10, paste_sources=two[1:])
    assert [t["labels"].tolist() for _, t in pasted] == [[1, 2]] * 10
