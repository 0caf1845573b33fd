"""COCO result rows of an image's detections."""

from collections.abc import Mapping

import numpy as np
from torch import Tensor

from cohdc_train.masks import roi_window
from cohdc_train.metrics.rle import window_boundary, window_rle
from cohdc_train.types import Row

MAX_DETECTIONS = 100  # per image, as COCO counts them


def encode_detections(
    image_id: int, size: tuple[int, int], detections: Mapping[str, Tensor]
) -> list[Row]:
    """Encode the best 100 detections of an image as COCO result rows, best score first.

    Args:
        image_id: id of the image in the COCO dict.
        size: (height, width) px.
        detections: `boxes` [n, 4] xyxy px of the image, `labels` [n] from 0, `scores` [n],
            `quality` [n], `masks` [n, M, M] probabilities inside the box.

    Returns:
        Rows with image_id, category_id from 1, score, quality, bbox xywh, and two compressed RLEs:
        segmentation, the pasted mask, and boundary, the band along its contour.
    """
    arrays = {name: value.detach().float().cpu().numpy() for name, value in detections.items()}
    rows = []
    for i in np.argsort(-arrays["scores"], kind="stable")[:MAX_DETECTIONS]:
        x0, y0, x1, y1 = (float(v) for v in arrays["boxes"][i])
        window, corner = roi_window(arrays["masks"][i], arrays["boxes"][i], size)
        rows.append(
            {
                "image_id": image_id,
                "category_id": int(arrays["labels"][i]) + 1,
                "score": float(arrays["scores"][i]),
                "quality": float(arrays["quality"][i]),
                "bbox": [x0, y0, x1 - x0, y1 - y0],
                "segmentation": window_rle(window, corner, size),
                "boundary": window_rle(window_boundary(window, size), corner, size),
            }
        )
    return rows
