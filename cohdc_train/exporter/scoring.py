"""Scores of a network, and of the ONNX files that are written from it."""

from pathlib import Path

from cohdc_train.segmenter import Segmenter
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.validation import score_module, score_segmenter, validation_data

SCORES = ("segm_AP", "segm_AP50", "boundary_AP", "box_AP", "S90_matched", "S90_all")


class ValidationScorer:
    """Scores a network and files written from it on a folder's validation split.

    Raises:
        CohdcError: the folder does not have the checkpoint's classes.
    """

    def __init__(self, module: MaskRCNNModule, data: Path, checkpoint: Path) -> None:
        """Open the folder with the classes of the checkpoint."""
        self._module = module
        self._data = validation_data(data, checkpoint, module.class_names)

    def score_network(self) -> dict[str, float]:
        """Compute SCORES of the network in torch, float32."""
        scores = score_module(self._module, self._data).scores
        return {name: scores[name] for name in SCORES}

    def score_file(self, path: Path) -> dict[str, float]:
        """Compute SCORES of an ONNX file, masks ranked as the network's are."""
        split = self._data.folder.val
        scores = score_segmenter(Segmenter(path), split, self._module.rescore).scores
        return {name: scores[name] for name in SCORES}
