"""What an ONNX file scores on a validation split, beside the network it was written from, and how long it takes."""

import statistics
import time
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cohdc_train.segmenter import Segmenter
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.validate import score_module, score_segmenter, validation_data

SCORES = ("segm_AP", "segm_AP50", "boundary_AP", "box_AP", "S90_matched", "S90_all")


class Scorer:
    """Scores of a network and of files written from it, on the validation split of a COCO-format folder.

    Raises CohdcError when the folder does not have the checkpoint's classes.
    """

    def __init__(self, module: MaskRCNNModule, root: Path, checkpoint: Path) -> None:
        self._module = module
        self._data = validation_data(root, checkpoint, module.class_names)

    def network(self) -> dict[str, float]:
        """SCORES by torch, float32."""
        return self._network

    @cached_property
    def _network(self) -> dict[str, float]:
        scores = score_module(self._module, self._data).scores
        return {name: scores[name] for name in SCORES}

    def file(self, path: Path) -> dict[str, float]:
        """SCORES of an ONNX file, masks ranked as the network's are."""
        scores = score_segmenter(Segmenter(path), self._data.folder.val, self._module.rescore).scores
        return {name: scores[name] for name in SCORES}


def seconds_per_image(files: Sequence[Path], pictures: Sequence[NDArray[np.uint8]]) -> list[float]:
    """Median of each file's time for one picture, uint8 [H, W, 3], on one thread; the files take turns."""
    segmenters = [Segmenter(path, threads=1) for path in files]
    taken: list[list[float]] = [[] for _ in files]
    for picture in (pictures[0], *pictures):  # the first warms up
        for segmenter, times in zip(segmenters, taken, strict=True):
            start = time.perf_counter()
            segmenter(picture)
            times.append(time.perf_counter() - start)
    return [statistics.median(times[1:]) for times in taken]
