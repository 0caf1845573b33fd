"""`cohdc export`: checkpoint to ONNX, float32 and int8 (torch is loaded when it runs)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cohdc_train.errors import CohdcError


@dataclass(frozen=True)
class ExportOptions:
    """Options of `cohdc export`.

    Attributes:
        images: folder of images to compare on, best with objects in them; drawn shapes when not
            given.
        canvas: height and width in px that the file fits images into; the training's when not
            given. A larger one finds smaller objects and takes longer.
        data: COCO-format folder on whose validation split network and file are scored.
        int8: folder of images such as the robot will see: writes `<file>.int8.onnx` too, with
            ranges measured on them. Needs `--data` for its scores, and is refused when mask AP
            falls by more than a point.
        allow_drop: keep an int8 file that loses more, or that nothing was scored on.
        verify_only: compare `out` as it is and write nothing.
    """

    images: Path | None = None
    canvas: tuple[int, int] | None = None
    data: Path | None = None
    int8: Path | None = None
    allow_drop: bool = False
    verify_only: bool = False

    def __post_init__(self) -> None:
        """Check that int8 can be scored."""
        if self.int8 is not None and self.data is None and not self.allow_drop:
            raise CohdcError(
                f"{self.int8}: int8 needs --data, whose AP tells what it loses, or --allow-drop"
            )


def export(checkpoint: Path | str, out: Path | str | None = None, **options: Any) -> Path:
    """Write a checkpoint as an ONNX file, compared with the torch network before it is kept.

    The comparison runs batches of 1, 2 and 4 at three image sizes, a black image and one full of
    objects. Images on which torch's own detections depend on rounding are skipped, a quarter at
    most. `<file>.json` reports largest differences, smallest mask IoU, size, nodes, GFLOPs, and
    both APs with `--data`.

    Args:
        checkpoint: a `.ckpt` of `cohdc fit`. With `--verify-only` also an ONNX file, whose report
            names its checkpoint.
        out: file to write; `model.onnx` next to the checkpoint when not given.
        **options: fields of `ExportOptions`.

    Returns:
        The path of the file.

    Raises:
        ExportError: outputs differ by more than 1e-2 px (boxes), 1e-4 (scores) or 1e-3 (masks,
            quality), or mask AP by more than a tenth of a point; nothing is left. Or int8 loses too
            much; only the float32 file is left.
        CohdcError: the checkpoint or a folder cannot be used.
    """
    settings = ExportOptions(**options)

    from cohdc_train.exporter.steps import export_checkpoint

    target = None if out is None else Path(out)
    return export_checkpoint(Path(checkpoint), target, settings)
