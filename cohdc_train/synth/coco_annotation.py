"""Turn masks into COCO annotations, in numpy and OpenCV."""

from typing import Any

import numpy as np

from cohdc_train.contour import pixel_borders
from cohdc_train.types import Mask


def run_lengths(mask: Mask) -> dict[str, list[int]]:
    """Return COCO's uncompressed RLE of a mask [H, W]: runs of 0, 1, ... by column."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(np.diff(flat)) + 1
    edges = np.concatenate([[0] if not flat[0] else [0, 0], changes, [flat.size]])
    return {"size": [int(v) for v in mask.shape], "counts": [int(v) for v in np.diff(edges)]}


def annotate(mask: Mask, image_id: int, annotation_id: int, crowd: bool = False) -> dict[str, Any]:
    """Return the COCO annotation of one visible person.

    It has polygons, or run lengths where a part has a hole.

    Args:
        mask: [H, W] bool, not empty.
        image_id: of the image.
        annotation_id: of the annotation.
        crowd: losses and scores ignore the person.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    left, top = int(columns[0]), int(rows[0])
    polygons = None if crowd else pixel_borders(mask)
    return {
        "id": annotation_id,
        "image_id": image_id,
        "category_id": 1,
        "iscrowd": int(crowd),
        "area": int(mask.sum()),
        "bbox": [left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1],
        "segmentation": run_lengths(mask) if polygons is None else polygons,
    }
