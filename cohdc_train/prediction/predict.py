"""`cohdc predict`: images, folders, videos or a webcam through an ONNX -> overlays and annotation
files (no torch).
"""

import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from cohdc_train.contour import ContourMethod, Polygon, simplify, trace
from cohdc_train.drawing import encode_jpeg
from cohdc_train.errors import DataError
from cohdc_train.files import OwnFiles, claim_folder, write_bytes
from cohdc_train.prediction.annotation_writers import FILES, Format, Found, coco, open_format
from cohdc_train.prediction.drawing import draw
from cohdc_train.prediction.image_sources import Picture, read_pictures
from cohdc_train.segmenter import Detections, Segmenter
from cohdc_train.types import Image

_VERB = "predict"


class Network(Protocol):
    """What finds the objects: a `Segmenter`, or anything that answers like one."""

    class_names: tuple[str, ...]

    def __call__(self, rgb: Image, /) -> Detections:
        """rgb: uint8 [H, W, 3] -> what was found."""


def predict(
    source: Path,
    *,
    model: Path,
    out: Path,
    score: float = 0.5,
    quality: float | None = None,
    format: Format = "coco",
    contour: ContourMethod = "bas_dp",
    iou_floor: float = 0.95,
    check_below: float = 0.7,
    threads: int = 0,
    frames: int | None = None,
) -> dict[str, Any]:
    """Find objects in an image, a folder of images, a video or a webcam's pictures.

    Writes `<name>_overlay.jpg` per image (in overlays/ unless the format is coco) and the objects'
    polygons: one COCO file (predictions.json), a labelme file per image, or YOLO-seg labels with
    their data.yaml. With labelme a person corrects contours instead of drawing them: every shape
    has its score and quality, those to check come first, and review.txt lists the images by what is
    to do. Returns the objects as a COCO dictionary, whatever was written. Raises DataError for
    images that cannot be read and for a folder with labelme files, which may be somebody's work;
    ContractError for a model that does not keep the contract. What was found before an image that
    cannot be read is written all the same.

    Args:
        source: an image, a folder of images, a video, or a webcam's number such as 0.
        model: ONNX file written by `cohdc export`, a foreign one that is known, or a shipped
            network's name: person, person_s.
        out: folder for the results.
        score: least class score that is kept.
        quality: least mask quality that is kept; without it nothing is dropped for its quality.
        format: coco, labelme or yolo.
        contour: how outlines become polygons: bas_dp has the fewest vertices, bisection is the
            fastest; dp has a fixed tolerance of 2 px and knows no floor.
        iou_floor: least IoU of a written polygon with its mask; 1 keeps every pixel.
        check_below: mask quality below which a contour is marked to be checked, in labelme files.
        threads: onnxruntime's threads; 0 leaves it to onnxruntime.
        frames: most pictures that are looked at; when not given all there are, and 100 of a webcam.
    """
    for name, value in {
        "score": score,
        "quality": quality or 0,
        "iou_floor": iou_floor,
        "check_below": check_below,
    }.items():
        if not 0 <= value <= 1:
            raise DataError(f"{name} is {value:g}; it must lie within 0..1")
    if out.exists() and not out.is_dir():
        raise DataError(f"{out}: is not a folder")
    pictures = read_pictures(source, frames)
    network = Segmenter(model, threads)
    started = time.perf_counter()
    result = predict_pictures(
        pictures,
        network,
        out,
        (score, quality),
        iou_floor,
        contour=contour,
        format=format,
        check_below=check_below,
    )
    seconds = time.perf_counter() - started
    images, objects = len(result["images"]), len(result["annotations"])
    print(
        f"{objects} objects in {images} images, {1e3 * seconds / images:.0f} ms per image with drawing, in {out}"
    )
    return result


def predict_pictures(
    pictures: Iterable[Picture],
    network: Network,
    out: Path,
    least: tuple[float, float | None] = (0.5, None),
    iou_floor: float = 0.95,
    *,
    contour: ContourMethod = "bas_dp",
    format: Format = "coco",
    check_below: float = 0.7,
) -> dict[str, Any]:
    """Overlays and annotation files of pictures, in `out`. least: (score, quality or None) that are
    kept.

    An object whose mask covers no pixel's centre has no outline and is left out. Returns the COCO
    dictionary. Raises DataError when `out` holds files of these names that no former prediction
    wrote.
    """
    # Apart from files that tools take for a data set.
    overlays = "" if format == "coco" else "overlays/"
    present = [path.name for path in out.glob("*_overlay.jpg")] if format == "coco" else []
    claim_folder(out, _VERB, [*FILES[format], *sorted(present)])
    (out / overlays).mkdir(exist_ok=True)
    seen: list[Found] = []
    with OwnFiles(out, _VERB) as own:
        files = open_format(format, out, own, network.class_names, check_below)
        try:
            for picture in pictures:
                found = _kept(network(picture.rgb), *least)
                outlines = [_outline(mask, iou_floor, contour) for mask in found.masks()]
                found = found.select(np.array([bool(outline) for outline in outlines], np.bool_))
                outlines = [outline for outline in outlines if outline]
                overlay = own.path(f"{overlays}{picture.stem}_overlay.jpg")
                write_bytes(overlay, encode_jpeg(draw(picture.rgb, found, outlines)))
                files.picture(picture, one := Found.of(picture, found, outlines))
                seen.append(one)
        except DataError:
            if seen:
                files.close(seen, coco(seen, network.class_names))
            raise
        files.close(seen, content := coco(seen, network.class_names))
    return content


def _outline(mask: NDArray[np.bool_], iou_floor: float, contour: ContourMethod) -> list[Polygon]:
    """A mask's polygons; exact ones where a fixed tolerance leaves nothing. Empty for an empty
    mask.
    """
    exact = trace(mask)
    return simplify(exact, iou_floor, contour) or exact


def _kept(found: Detections, score: float, quality: float | None) -> Detections:
    keep = found.scores >= score
    return found.select(keep if quality is None else keep & (found.quality >= quality))
