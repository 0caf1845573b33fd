"""Checkpoint -> ONNX, fp32 and int8, each proven before it gets its name."""

from pathlib import Path


def export(
    checkpoint: Path,
    out: Path | None = None,
    images: Path | None = None,
    canvas: tuple[int, int] | None = None,
    data: Path | None = None,
    int8: Path | None = None,
    allow_drop: bool = False,
    verify_only: bool = False,
) -> Path:
    """Write a checkpoint as an ONNX file that keeps the contract, proven equal to the torch
    network.

    The proof runs batches of 1, 2 and 4 at three image sizes, a black image and one full of
    objects. Images on which torch's own detections hinge on rounding are left out, a quarter at
    most. Beside the file lies `<file>.json`: largest differences, smallest mask IoU, size, nodes,
    GFLOPs, and with `--data` both APs.

    Args:
        checkpoint: a `.ckpt` of `cohdc fit`. With `--verify-only` also an ONNX file, whose report
            names its checkpoint.
        out: the file to write; `model.onnx` beside the checkpoint when left out.
        images: folder of pictures to compare on, best with objects on them; drawn shapes when left
            out.
        canvas: height and width in px that the file fits images into; the training's when left out.
            A larger one finds smaller objects and takes longer.
        data: COCO-format folder whose validation split both are scored on.
        int8: folder of pictures such as the robot will see: writes `<file>.int8.onnx` besides, with
            ranges measured on them. It needs `--data` for its scores, and is refused when mask AP
            falls by more than a point.
        allow_drop: keep an int8 file that loses more, or that nothing was scored on.
        verify_only: compare `out` as it is and write nothing.

    Returns:
        The path of the file.

    Raises:
        ExportError: outputs differ by more than 1e-2 px (boxes), 1e-4 (scores), 1e-3 (masks,
            quality), mask AP by more than a tenth of a point; nothing is left. Or int8 loses too
            much; only the float32 file is left.
        CohdcError: the checkpoint or a folder cannot be read.
    """
    from cohdc_train.exporter.steps import run

    return run(checkpoint, out, images, canvas, data, int8, allow_drop, verify_only)
