"""Who found whom: each image's objects and confident detections, matched; what a validation's
pictures count.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as rle

from cohdc_train.metrics.coco_metrics import CERTAIN, MATCH_IOU, Results
from cohdc_train.metrics.rle import to_rle
from cohdc_train.types import Row


@dataclass(frozen=True)
class ImageMatch:
    """One image's objects and the detections of class score .5 and more that the scores count.

    Attributes:
        image_id: of the COCO dict.
        objects: its rows without crowds; `segmentation` is a compressed RLE.
        crowds: the crowds' rows, likewise.
        detections: `encode`'s rows, best score first; those that found nothing and lie in a crowd
            are left out.
        found: [objects] index of the detection that found it, -1 where none did.
        overlaps: [detections, objects] mask IoU.
    """

    image_id: int
    objects: list[Row]
    crowds: list[Row]
    detections: list[Row]
    found: NDArray[np.int64]
    overlaps: NDArray[np.float64]

    @property
    def right(self) -> NDArray[np.bool_]:
        """[objects] found, and as the right class."""
        same = [
            i >= 0 and self.detections[i]["category_id"] == o["category_id"]
            for i, o in self.pairs()
        ]
        return np.array(same, np.bool_)

    @property
    def score(self) -> float:
        """How well the image was predicted, 0..1: the sum of the mask IoUs of the objects found as
        the right class over the number of objects and of detections that found none. A miss and a
        false detection each count as 0, a wrong class as both. nan where there is nothing to find
        and nothing was found."""
        counted = len(self.objects) + len(self.detections) - int(self.right.sum())
        overlaps = [self.overlaps[i, j] for j, (i, _) in enumerate(self.pairs()) if self.right[j]]
        return float(sum(overlaps)) / counted if counted else np.nan

    def pairs(self) -> list[tuple[int, Row]]:
        """(index of the detection that found it or -1, object) of every object."""
        return [(int(i), o) for i, o in zip(self.found, self.objects, strict=True)]

    def missed(self) -> list[Row]:
        """The objects that no detection found."""
        return [o for i, o in self.pairs() if i < 0]


def match_images(results: Results) -> list[ImageMatch]:
    """Every image of a validation, by id.

    At mask IoU >= .5, detections from the best score down take the free object of their class they
    overlap most, as COCO matches; those left over then take what is still free of any class.
    """
    sizes = {image["id"]: (image["height"], image["width"]) for image in results.truth["images"]}
    truth: dict[int, list[Row]] = defaultdict(list)
    for row in results.truth["annotations"]:
        shape = to_rle(row["segmentation"], sizes[row["image_id"]])
        truth[row["image_id"]].append({**row, "segmentation": shape})
    detections: dict[int, list[Row]] = defaultdict(list)
    for row in results.kept:
        if row["score"] >= CERTAIN:
            detections[row["image_id"]].append(row)
    return [_match(image_id, truth[image_id], detections[image_id]) for image_id in sorted(sizes)]


def ranked(matches: Iterable[ImageMatch], count: int) -> tuple[list[ImageMatch], list[ImageMatch]]:
    """The best predicted images, best first, and the worst, worst first, by `ImageMatch.score`.

    At most `count` each and no image in both, unless there is only one; images without a score are
    in neither. Of equal scores, the image with more objects and detections goes first.
    """
    scored = [match for match in matches if not np.isnan(match.score)]
    count = min(count, max(1, len(scored) // 2))
    by_size = sorted(scored, key=lambda match: -len(match.objects) - len(match.detections))
    worst = sorted(by_size, key=lambda match: match.score)[:count]
    taken = {match.image_id for match in worst} if len(scored) > 1 else set()
    others = [match for match in by_size if match.image_id not in taken]
    return sorted(others, key=lambda match: -match.score)[:count], worst


def confusion_matrix(matches: Iterable[ImageMatch], classes: int) -> NDArray[np.int64]:
    """[C + 1, C + 1] counts, true class in rows and predicted class in columns; the last column
    counts missed objects, the last row false detections."""
    counts = np.zeros((classes + 1, classes + 1), np.int64)
    for match in matches:
        for i, o in match.pairs():
            counts[
                o["category_id"] - 1, match.detections[i]["category_id"] - 1 if i >= 0 else classes
            ] += 1
        for i, row in enumerate(match.detections):
            counts[classes, row["category_id"] - 1] += i not in match.found
    return counts


def _match(image_id: int, truth: Sequence[Row], detections: list[Row]) -> ImageMatch:
    objects = [row for row in truth if not row["iscrowd"]]
    crowds = [row for row in truth if row["iscrowd"]]
    detections = sorted(detections, key=lambda row: -row["score"])
    overlaps = _overlaps(detections, objects, crowd=False)
    found = np.full(len(objects), -1, np.int64)
    same = _of_one_class(detections, objects)
    for allowed in (same, ~same):
        for i in range(len(detections)):
            free = np.where(allowed[i] & (found < 0) & (i not in found), overlaps[i], 0.0)
            if free.max(initial=0.0) >= MATCH_IOU:
                found[free.argmax()] = i
    in_crowd = _of_one_class(detections, crowds) & (
        _overlaps(detections, crowds, crowd=True) >= MATCH_IOU
    )
    kept = [i for i in range(len(detections)) if i in found or not in_crowd[i].any()]
    place = np.full(len(detections) + 1, -1, np.int64)  # the last one answers for -1
    place[kept] = np.arange(len(kept))
    return ImageMatch(
        image_id, objects, crowds, [detections[i] for i in kept], place[found], overlaps[kept]
    )


def _of_one_class(detections: Sequence[Row], truth: Sequence[Row]) -> NDArray[np.bool_]:
    same = [[d["category_id"] == o["category_id"] for o in truth] for d in detections]
    return np.array(same, np.bool_).reshape(len(detections), len(truth))


def _overlaps(detections: Sequence[Row], truth: Sequence[Row], crowd: bool) -> NDArray[np.float64]:
    """[detections, truth] mask IoU; with a crowd the share of the detection that lies in it."""
    if not detections or not truth:
        return np.zeros((len(detections), len(truth)))
    shapes = [[row["segmentation"] for row in rows] for rows in (detections, truth)]
    return np.asarray(rle.iou(*shapes, [int(crowd)] * len(truth)), np.float64)
