"""Objects and confident detections of each image, matched, for the figures of a validation."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cohdc_train.metrics.coco_metrics import Results
from cohdc_train.metrics.mask_overlap import MATCH_IOU, MIN_SCORE, mask_ious, match_greedily
from cohdc_train.metrics.rle import to_rle
from cohdc_train.types import Row


@dataclass(frozen=True)
class ImageMatch:
    """Objects of one image and its detections with a score of at least .5 that the scores count.

    Attributes:
        image_id: id of the image in the COCO dict.
        objects: annotation rows without crowds; `segmentation` is a compressed RLE.
        crowds: annotation rows of crowds, likewise.
        detections: rows of `encode_detections`, best score first; those that match no object and
            lie in a crowd are dropped.
        detection_of: [objects] index of each object's detection, -1 where there is none.
        overlaps: [detections, objects] mask IoU.
    """

    image_id: int
    objects: list[Row]
    crowds: list[Row]
    detections: list[Row]
    detection_of: NDArray[np.int64]
    overlaps: NDArray[np.float64]

    @property
    def is_correct(self) -> NDArray[np.bool_]:
        """[objects] bool: detected, and as the right class."""
        correct = [
            i >= 0 and self.detections[i]["category_id"] == row["category_id"]
            for i, row in self.pairs()
        ]
        return np.array(correct, np.bool_)

    @property
    def score(self) -> float:
        """Score of the prediction, 0..1; nan without objects and detections.

        The sum of the mask IoUs of the correctly detected objects over the number of objects and of
        detections that match none. A miss and a false detection each count as 0, a wrong class as
        both.
        """
        is_correct = self.is_correct
        count = len(self.objects) + len(self.detections) - int(is_correct.sum())
        overlaps = [self.overlaps[i, j] for j, (i, _) in enumerate(self.pairs()) if is_correct[j]]
        return float(sum(overlaps)) / count if count else np.nan

    def pairs(self) -> list[tuple[int, Row]]:
        """Return (index of its detection or -1, object) of each object."""
        return [(int(i), row) for i, row in zip(self.detection_of, self.objects, strict=True)]

    def missed(self) -> list[Row]:
        """Return the objects without a detection."""
        return [row for i, row in self.pairs() if i < 0]


def match_images(results: Results) -> list[ImageMatch]:
    """Match objects and detections in each image of a validation, by image id.

    At mask IoU >= .5, detections from the best score down take the free object of their class that
    they overlap most, as COCO matches; the rest then take what is still free of any class.
    """
    sizes = {image["id"]: (image["height"], image["width"]) for image in results.truth["images"]}
    truth: dict[int, list[Row]] = defaultdict(list)
    for row in results.truth["annotations"]:
        shape = to_rle(row["segmentation"], sizes[row["image_id"]])
        truth[row["image_id"]].append({**row, "segmentation": shape})
    detections: dict[int, list[Row]] = defaultdict(list)
    for row in results.kept:
        if row["score"] >= MIN_SCORE:
            detections[row["image_id"]].append(row)
    return [
        _match_image(image_id, truth[image_id], detections[image_id]) for image_id in sorted(sizes)
    ]


def best_and_worst(
    matches: Iterable[ImageMatch], count: int
) -> tuple[list[ImageMatch], list[ImageMatch]]:
    """Select the best images, best first, and the worst, worst first, by `ImageMatch.score`.

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


def confusion_matrix(matches: Iterable[ImageMatch], num_classes: int) -> NDArray[np.int64]:
    """Count true classes in rows and predicted classes in columns.

    Returns:
        [C + 1, C + 1]; the last column counts missed objects, the last row false detections.
    """
    counts = np.zeros((num_classes + 1, num_classes + 1), np.int64)
    for match in matches:
        for i, row in match.pairs():
            predicted = match.detections[i]["category_id"] - 1 if i >= 0 else num_classes
            counts[row["category_id"] - 1, predicted] += 1
        for i, row in enumerate(match.detections):
            counts[num_classes, row["category_id"] - 1] += i not in match.detection_of
    return counts


def _match_image(image_id: int, truth: Sequence[Row], detections: list[Row]) -> ImageMatch:
    """Match one image; truth: its annotation rows with compressed RLEs."""
    objects = [row for row in truth if not row["iscrowd"]]
    crowds = [row for row in truth if row["iscrowd"]]
    detections = sorted(detections, key=lambda row: -row["score"])
    overlaps = mask_ious(detections, [row["segmentation"] for row in objects])

    # Detections of an object's own class come first, those of other classes take what is left.
    has_same_class = _same_class(detections, objects)
    matched = match_greedily(overlaps, has_same_class)
    matched = match_greedily(overlaps, ~has_same_class, matched)

    # A detection that matches nothing and lies in a crowd of its class is not counted.
    crowd_shares = mask_ious(detections, [row["segmentation"] for row in crowds], crowd=True)
    in_crowd = _same_class(detections, crowds) & (crowd_shares >= MATCH_IOU)
    kept = [i for i in range(len(detections)) if i in matched or not in_crowd[i].any()]
    new_index = np.full(len(detections) + 1, -1, np.int64)  # the last one stands for -1
    new_index[kept] = np.arange(len(kept))
    kept_detections = [detections[i] for i in kept]
    return ImageMatch(
        image_id, objects, crowds, kept_detections, new_index[matched], overlaps[kept]
    )


def _same_class(detections: Sequence[Row], truth: Sequence[Row]) -> NDArray[np.bool_]:
    """Return [D, G] bool: detection and object are of one class."""
    same = [[d["category_id"] == row["category_id"] for row in truth] for d in detections]
    return np.array(same, np.bool_).reshape(len(detections), len(truth))
