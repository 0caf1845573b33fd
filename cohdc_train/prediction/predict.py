"""`cohdc predict`: an ONNX file on images, a video or a webcam (no torch)."""

import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from cohdc_train.contour import Polygon, simplify, trace
from cohdc_train.drawing import write_jpeg
from cohdc_train.errors import DataError
from cohdc_train.files import OwnFiles, claim_folder
from cohdc_train.prediction.annotation_writers import (
    FORMAT_FILES,
    ImageDetections,
    coco_content,
    open_writer,
)
from cohdc_train.prediction.drawing import draw_detections
from cohdc_train.prediction.image_sources import SourceImage, read_images
from cohdc_train.prediction.options import PredictOptions
from cohdc_train.segmenter import Detections, Segmenter
from cohdc_train.types import Image, Mask

_COMMAND = "predict"


class SegmenterLike(Protocol):
    """A `Segmenter`, or anything that is called like one."""

    class_names: tuple[str, ...]

    def __call__(self, rgb: Image, /) -> Detections:
        """Segment an image. rgb: uint8 [H, W, 3]."""


def predict(
    source: Path | str, *, model: Path | str, out: Path | str, **options: Any
) -> dict[str, Any]:
    """Segment an image, a folder of images, a video or a webcam's images.

    Writes `<name>_overlay.jpg` per image (in overlays/ unless the format is coco) and the objects'
    polygons: one COCO file (predictions.json), a labelme file per image, or YOLO-seg labels with
    their data.yaml. labelme files are made to be corrected by hand: every shape has its score and
    quality, those to check come first, and review.txt lists the images by the number of contours to
    check. Objects found before an image that cannot be read are written all the same.

    Args:
        source: an image, a folder of images, a video, or a webcam's number such as 0.
        model: ONNX file of `cohdc export` or of a known other exporter, or a shipped network's
            name: person, person_s.
        out: folder for the results.
        **options: fields of `PredictOptions`.

    Returns:
        The objects as a COCO dictionary, in whatever format they were written.

    Raises:
        DataError: an option or an image is wrong, or the folder holds files that somebody may have
            edited.
        ContractError: the model cannot be used.
    """
    settings = PredictOptions(**options)
    source, out = Path(source), Path(out)
    if out.exists() and not out.is_dir():
        raise DataError(f"{out}: is not a folder")
    images = read_images(source, settings.frames)
    segmenter = Segmenter(model, settings.threads)
    start = time.perf_counter()
    result = predict_images(images, segmenter, out, settings)
    seconds = time.perf_counter() - start

    num_images, num_objects = len(result["images"]), len(result["annotations"])
    pace = f"{1e3 * seconds / num_images:.0f} ms per image with drawing"
    print(f"{num_objects} objects in {num_images} images, {pace}, in {out}")
    return result


def predict_images(
    images: Iterable[SourceImage],
    segmenter: SegmenterLike,
    out: Path,
    options: PredictOptions = PredictOptions(),  # noqa: B008 - frozen
) -> dict[str, Any]:
    """Segment images, and write their overlays and annotation files into a folder.

    An object whose mask covers no pixel has no outline and is skipped.

    Returns:
        The objects as a COCO dictionary.

    Raises:
        DataError: an image is wrong, or `out` holds files of these names that no former prediction
            wrote.
    """
    # Overlays must not lie where other tools look for the images of a data set.
    is_coco = options.format == "coco"
    overlays = "" if is_coco else "overlays/"
    present = sorted(path.name for path in out.glob("*_overlay.jpg")) if is_coco else []
    claim_folder(out, _COMMAND, [*FORMAT_FILES[options.format], *present])
    (out / overlays).mkdir(exist_ok=True)

    results: list[ImageDetections] = []
    with OwnFiles(out, _COMMAND) as own:
        writer = open_writer(out, own, segmenter.class_names, options)
        try:
            for image in images:
                result = _segment(image, segmenter, options)
                overlay = draw_detections(image.rgb, result.detections, result.outlines)
                write_jpeg(own.path(f"{overlays}{image.stem}_overlay.jpg"), overlay)
                writer.write_image(image, result)
                results.append(result)
        except DataError:
            if results:
                writer.finish(results, coco_content(results, segmenter.class_names))
            raise
        content = coco_content(results, segmenter.class_names)
        writer.finish(results, content)
    return content


def _segment(
    image: SourceImage, segmenter: SegmenterLike, options: PredictOptions
) -> ImageDetections:
    """Segment an image, and keep the objects that the options ask for and that have an outline."""
    detections = segmenter(image.rgb)
    keep = detections.scores >= options.score
    if options.quality is not None:
        keep &= detections.quality >= options.quality
    detections = detections.select(keep)

    outlines = [_outline(mask, options) for mask in detections.masks()]
    has_outline = np.array([bool(outline) for outline in outlines], np.bool_)
    size = (image.rgb.shape[0], image.rgb.shape[1])
    kept = [outline for outline in outlines if outline]
    return ImageDetections(image.name, size, detections.select(has_outline), kept)


def _outline(mask: Mask, options: PredictOptions) -> list[Polygon]:
    """Convert a mask to polygons; exact ones where a fixed tolerance would remove all of it."""
    exact = trace(mask)
    return simplify(exact, options.iou_floor, options.contour) or exact
