"""Checkpoint -> ONNX. The file is run and compared with the network before it gets its name."""

import json
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cohdc_train import __version__, signature
from cohdc_train.errors import CohdcError, ExportError
from cohdc_train.files import write_json

if TYPE_CHECKING:
    from cohdc_train.models import MaskRCNN

OPSET = 18
MASK_THRESHOLD = 0.5
TOLERANCES = {"boxes": 1e-2, "scores": 1e-4, "quality": 1e-3, "masks": 1e-3}  # boxes in px of the input image
_IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".webp"}
_PARITY_IMAGES = 4


def export(
    checkpoint: Path, out: Path | None = None, images: Path | None = None, canvas: tuple[int, int] | None = None
) -> Path:
    """Write a checkpoint as an ONNX file that keeps the contract, proven equal to the torch network.

    The proof runs two image sizes, batches of one and two, and a black image. Beside the file lies `<file>.json` with
    the largest differences.

    Args:
        checkpoint: a `.ckpt` of `cohdc fit`.
        out: the file to write; `model.onnx` beside the checkpoint when left out.
        images: folder of pictures to compare on, best with objects on them; drawn shapes when left out.
        canvas: height and width in px that the file fits images into; the training's when left out. A larger one finds
            smaller objects and takes longer.

    Returns:
        The path of the file.

    Raises:
        ExportError: outputs differ by more than 1e-2 px (boxes), 1e-4 (scores), 1e-3 (masks, quality); nothing is left.
        CohdcError: the checkpoint or the folder cannot be read.
    """
    import torch

    from cohdc_train.train.module import MaskRCNNModule

    started = time.monotonic()
    module = MaskRCNNModule.load(Path(checkpoint), canvas)
    target = Path(out) if out is not None else Path(checkpoint).parent / "model.onnx"
    pictures = _read_images(Path(images)) if images is not None else _drawn_images()
    network = module.network.float().cpu().eval()
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        nodes = _write_onnx(network, list(module.class_names), temporary)
        with torch.inference_mode():
            report = _compare(network, temporary, pictures)
        report = {
            "file": target.name,
            "bytes": temporary.stat().st_size,
            "nodes": nodes,
            "opset": OPSET,
            "contract": signature.CONTRACT_VERSION,
            "version": __version__,
            "classes": list(module.class_names),
            "seconds": round(time.monotonic() - started, 1),
            **report,
        }
        _require_parity(target, report)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
    write_json(target.with_name(target.name + ".json"), report)
    worst = ", ".join(f"{name} {report['max_difference'][name]:.1e}" for name in TOLERANCES)
    print(
        f"{target}: {report['bytes'] / 1e6:.1f} MB, {nodes} nodes, opset {OPSET}; equals torch on "
        f"{len(report['cases'])} cases with {report['detections_compared']} detections (largest difference: {worst})"
    )
    return target


def _write_onnx(network: "MaskRCNN", class_names: list[str], path: Path) -> int:
    """Export and save with metadata; returns the number of nodes."""
    import onnx
    import torch

    from cohdc_train.models import Detector
    from cohdc_train.onnx_operators import TRANSLATIONS

    rows, columns = network.config.canvas
    example = torch.zeros((2, rows + 32, columns + 64, 3), dtype=torch.uint8)
    free = {i: torch.export.Dim(name) for i, name in enumerate(("batch", "height", "width"))}
    program = torch.onnx.export(
        Detector(network).eval(),
        (example,),
        dynamo=True,
        opset_version=OPSET,
        input_names=[signature.INPUT],
        output_names=list(signature.OUTPUTS),
        dynamic_shapes=(free,),
        custom_translation_table=TRANSLATIONS,
        verbose=False,
    )
    if program is None:
        raise ExportError(f"{path}: torch.onnx.export returned nothing")
    model = program.model_proto
    onnx.helper.set_model_props(model, _metadata(network, class_names))
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return len(model.graph.node)


def _metadata(network: "MaskRCNN", class_names: list[str]) -> dict[str, str]:
    config = network.config
    rule = {
        "color": "RGB",
        "layout": "NHWC",
        "dtype": "uint8",
        "canvas": list(config.canvas),
        "resize": "inside: fitted into the canvas, bilinear, antialiased, top left, black padding",
    }
    thresholds = {"score": config.score_threshold, "nms_iou": config.nms_iou, "mask": MASK_THRESHOLD}
    return {
        signature.KEY_CONTRACT: str(signature.CONTRACT_VERSION),
        signature.KEY_VERSION: __version__,
        signature.KEY_CLASSES: json.dumps(class_names),
        signature.KEY_INPUT: json.dumps(rule),
        signature.KEY_THRESHOLDS: json.dumps(thresholds),
    }


def _compare(network: "MaskRCNN", path: Path, pictures: list[NDArray[np.uint8]]) -> dict[str, Any]:
    """Run file and network on every case; returns the largest differences and what was compared."""
    import onnxruntime
    import torch

    from cohdc_train.models import Detector

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    detector = Detector(network).eval()
    rows, columns = network.config.canvas
    worst, cases, compared = dict.fromkeys(TOLERANCES, 0.0), [], 0
    for height, width in ((rows, columns), (columns * 5 // 4, rows * 3 // 2)):
        scene = [_resize(picture, height, width) for picture in pictures]
        black = [np.zeros((height, width, 3), np.uint8)]
        batches = [scene[:1], *(scene[i : i + 2] for i in range(0, len(scene) - 1, 2)), black]
        for batch in (np.stack(images) for images in batches):
            expected = [tensor.numpy() for tensor in detector(torch.from_numpy(batch))]
            actual = session.run(list(signature.OUTPUTS), {signature.INPUT: batch})
            for i in range(len(batch)):
                found = _difference([e[i] for e in expected], [a[i] for a in actual])
                worst = {name: max(worst[name], found[name]) for name in TOLERANCES}
            compared += int(expected[-1].sum())
            cases.append({"size": [height, width], "batch": len(batch), "detections": expected[-1].tolist()})
    return {"max_difference": worst, "tolerance": TOLERANCES, "detections_compared": compared, "cases": cases}


def _difference(expected: list[NDArray[Any]], actual: list[NDArray[Any]]) -> dict[str, float]:
    """Largest difference per output of one image; infinite where the detections are not the same.

    Rows of nearly equal score may stand in another order: each is compared with its nearest box of the same label.
    """
    count = int(expected[-1])
    if int(actual[-1]) != count:
        return dict.fromkeys(TOLERANCES, float("inf"))
    worst = dict.fromkeys(TOLERANCES, 0.0)
    fields = dict(zip(signature.OUTPUTS, zip(expected, actual, strict=True), strict=True))
    free = list(range(count))
    for row in range(count):
        same = [j for j in free if actual[1][j] == expected[1][row]]
        if not same:
            return dict.fromkeys(TOLERANCES, float("inf"))
        partner = min(same, key=lambda j: float(np.abs(actual[0][j] - expected[0][row]).max()))
        free.remove(partner)
        for name in TOLERANCES:
            truth, value = fields[name]
            worst[name] = max(worst[name], float(np.abs(truth[row] - value[partner]).max()))
    for name in TOLERANCES:  # padding is zero on both sides
        worst[name] = max(worst[name], *(float(np.abs(side[count:]).max(initial=0.0)) for side in fields[name]))
    return worst


def _resize(picture: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    import cv2

    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _require_parity(target: Path, report: dict[str, Any]) -> None:
    for name, limit in TOLERANCES.items():
        difference = report["max_difference"][name]
        if not difference <= limit:
            raise ExportError(
                f"{target}: {name} differ from torch by {difference:.3g}, allowed {limit:g}; no file left"
            )


def _read_images(folder: Path) -> list[NDArray[np.uint8]]:
    import cv2

    if not folder.is_dir():
        raise CohdcError(f"{folder}: no such folder")
    names = sorted(path for path in folder.iterdir() if path.suffix.lower() in _IMAGE_SUFFIXES)
    if not names:
        raise CohdcError(f"{folder}: 0 images")
    step = max(1, len(names) // _PARITY_IMAGES)
    pictures = []
    for path in names[::step][:_PARITY_IMAGES]:
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
        if picture is None:
            raise CohdcError(f"{path}: not an image")
        pictures.append(np.asarray(picture, dtype=np.uint8))
    return pictures


def _drawn_images() -> list[NDArray[np.uint8]]:
    """Pictures of overlapping shapes on a noisy ground, always the same."""
    import cv2

    rng = np.random.default_rng(0)
    pictures = []
    for _ in range(_PARITY_IMAGES):
        picture = rng.integers(80, 140, (240, 320, 3)).astype(np.uint8)
        for _ in range(6):
            centre = (int(rng.integers(0, 320)), int(rng.integers(0, 240)))
            axes = (int(rng.integers(8, 40)), int(rng.integers(20, 80)))
            colour = [int(c) for c in rng.integers(0, 255, 3)]
            cv2.ellipse(picture, centre, axes, float(rng.uniform(-30, 30)), 0, 360, colour, -1)
        pictures.append(cv2.GaussianBlur(picture, (3, 3), 0).astype(np.uint8))
    return pictures
