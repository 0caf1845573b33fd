"""What an ONNX file scores on a validation split, beside the network it was written from."""

from pathlib import Path

from cohdc_train.segmenter import Segmenter
from cohdc_train.train.module import MaskRCNNModule
from cohdc_train.validation import score_module, score_segmenter, validation_data

SCORES = ("segm_AP", "segm_AP50", "boundary_AP", "box_AP", "S90_matched", "S90_all")


class Scorer:
    """Scores of a network and of files written from it, on the validation split of a COCO-format
    folder.

    Raises CohdcError when the folder does not have the checkpoint's classes.
    """

    def __init__(self, module: MaskRCNNModule, root: Path, checkpoint: Path) -> None:
        self._module = module
        self._data = validation_data(root, checkpoint, module.class_names)

    def network(self) -> dict[str, float]:
        """SCORES by torch, float32."""
        scores = score_module(self._module, self._data).scores
        return {name: scores[name] for name in SCORES}

    def file(self, path: Path) -> dict[str, float]:
        """SCORES of an ONNX file, masks ranked as the network's are."""
        scores = score_segmenter(
            Segmenter(path), self._data.folder.val, self._module.rescore
        ).scores
        return {name: scores[name] for name in SCORES}
