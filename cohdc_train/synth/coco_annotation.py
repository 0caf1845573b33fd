"""Masks -> COCO annotations, in numpy and OpenCV: outlines along pixel borders, run lengths where
there are holes.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def run_lengths(mask: Mask) -> dict[str, list[int]]:
    """COCO's uncompressed RLE: runs of 0, 1, 0, ... down the columns. mask: [H, W]."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(np.diff(flat)) + 1
    edges = np.concatenate([[0] if not flat[0] else [0, 0], changes, [flat.size]])
    return {"size": [int(v) for v in mask.shape], "counts": [int(v) for v in np.diff(edges)]}


def outlines(mask: Mask) -> list[list[float]] | None:
    """Polygons [x0, y0, x1, y1, ...] along the borders of the pixels, one per part; None when a
    part has a hole.

    mask: [H, W]. Every pixel is enlarged to 3 x 3, so that OpenCV's contour, which runs through
    pixel centres, lies within half a pixel of the border it stands for and rounds to it: the
    polygon covers exactly the mask.
    """
    count, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    polygons: list[list[float]] = []
    for part in range(1, count):
        large = np.kron((parts == part).astype(np.uint8), np.ones((3, 3), dtype=np.uint8))
        contours, _ = cv2.findContours(large, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        if len(contours) != 1:
            return None
        corners = np.rint((contours[0][:, 0] + 0.5) / 3)
        keep = np.any(corners != np.roll(corners, 1, axis=0), axis=1)
        polygons.append([float(v) for v in corners[keep].ravel()])
    return polygons


def annotate(mask: Mask, image_id: int, annotation_id: int, crowd: bool = False) -> dict[str, Any]:
    """The COCO annotation of one visible person. mask: [H, W], not empty; a crowd is ignored by
    losses and scores.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    left, top = int(columns[0]), int(rows[0])
    polygons = None if crowd else outlines(mask)
    return {
        "id": annotation_id,
        "image_id": image_id,
        "category_id": 1,
        "iscrowd": int(crowd),
        "area": int(mask.sum()),
        "bbox": [left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1],
        "segmentation": run_lengths(mask) if polygons is None else polygons,
    }
