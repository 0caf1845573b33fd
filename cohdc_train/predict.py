"""`cohdc predict`: images, folders, videos or a webcam through an ONNX -> overlays and one COCO file (no torch)."""

import json
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from cohdc_train.contour import Polygon, simplify, trace
from cohdc_train.errors import DataError
from cohdc_train.files import write_bytes, write_text
from cohdc_train.segmenter import Detections, Segmenter

Image = NDArray[np.uint8]

IMAGE_SUFFIXES = frozenset([".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff"])
VIDEO_SUFFIXES = frozenset([".mp4", ".avi", ".mkv", ".mov", ".webm"])
# RGB; neighbours in the list differ in hue, so that people side by side can be told apart
_COLOURS = ((230, 25, 75), (60, 180, 75), (0, 130, 200), (245, 130, 48), (145, 30, 180), (70, 240, 240), (240, 50, 230))
_WEBCAM_FRAMES = 100
_FILL = 0.45  # share of the colour in a filled mask


class Picture(NamedTuple):
    """One image to look at. name: its file name; overlay: file name of the drawing; rgb: uint8 [H, W, 3]."""

    name: str
    overlay: str
    rgb: Image


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
    iou_floor: float = 0.95,
    threads: int = 0,
    frames: int | None = None,
) -> dict[str, Any]:
    """Find objects in an image, a folder of images, a video or a webcam's pictures.

    Writes `<name>_overlay.jpg` per image and predictions.json, a COCO file with score and quality per annotation.
    Returns the content of predictions.json. Raises DataError for images that cannot be read, ContractError for a model
    that does not keep the contract.

    Args:
        source: an image, a folder of images, a video, or a webcam's number such as 0.
        model: ONNX file written by `cohdc export`, a foreign one that is known, or a shipped network's name: person.
        out: folder for the results.
        score: least class score that is kept.
        quality: least mask quality that is kept; without it nothing is dropped for its quality.
        iou_floor: least IoU of a written polygon with its mask; 1 keeps every pixel.
        threads: onnxruntime's threads; 0 leaves it to onnxruntime.
        frames: most pictures that are looked at; when not given all there are, and 100 of a webcam.
    """
    pictures = read_pictures(source, frames)
    network = Segmenter(model, threads)
    started = time.perf_counter()
    result = predict_pictures(pictures, network, out, (score, quality), iou_floor)
    seconds = time.perf_counter() - started
    images, objects = len(result["images"]), len(result["annotations"])
    print(f"{objects} objects in {images} images, {1e3 * seconds / images:.0f} ms per image with drawing, in {out}")
    return result


def predict_pictures(
    pictures: Iterable[Picture],
    network: Network,
    out: Path,
    least: tuple[float, float | None] = (0.5, None),
    iou_floor: float = 0.95,
) -> dict[str, Any]:
    """Overlays and predictions.json of pictures, in `out`. least: (score, quality or None) that are kept.

    An object whose mask covers no pixel's centre has no outline and is left out. Returns the COCO dictionary.
    """
    out.mkdir(parents=True, exist_ok=True)
    categories = [{"id": label + 1, "name": name} for label, name in enumerate(network.class_names)]
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for image_id, picture in enumerate(pictures, start=1):
        found = _kept(network(picture.rgb), *least)
        outlines = [simplify(trace(mask), iou_floor) for mask in found.masks()]
        found = found.select(np.array([bool(outline) for outline in outlines], np.bool_))
        outlines = [outline for outline in outlines if outline]
        height, width = picture.rgb.shape[:2]
        images.append({"id": image_id, "file_name": picture.name, "width": width, "height": height})
        for row, outline in enumerate(outlines):
            entry = {"id": len(annotations) + 1, "image_id": image_id, "file_name": picture.name}
            annotations.append(entry | _annotation(found, row, outline))
        write_bytes(out / picture.overlay, _jpeg(draw(picture.rgb, found, outlines)))
    result = {"images": images, "categories": categories, "annotations": annotations}
    write_text(out / "predictions.json", json.dumps(result))
    return result


def _kept(found: Detections, score: float, quality: float | None) -> Detections:
    keep = found.scores >= score
    return found.select(keep if quality is None else keep & (found.quality >= quality))


def _annotation(found: Detections, row: int, outline: list[Polygon]) -> dict[str, Any]:
    x0, y0, x1, y1 = (float(v) for v in found.boxes[row])
    label = int(found.labels[row])
    return {
        "category_id": label + 1,
        "category": found.class_names[label],
        "bbox": [round(v, 2) for v in (x0, y0, x1 - x0, y1 - y0)],
        "score": round(float(found.scores[row]), 5),
        "quality": round(float(found.quality[row]), 5),
        "segmentation": [polygon.keyhole().ravel().round(2).tolist() for polygon in outline],
        "area": round(sum(_area(polygon.keyhole()) for polygon in outline), 2),
        "iscrowd": 0,
    }


def _area(ring: NDArray[np.float64]) -> float:
    x, y = ring.T
    return float(abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2)


def read_pictures(source: Path, most: int | None = None) -> Iterator[Picture]:
    """The images behind a path, read one at a time: a file, a folder (by name, not its subfolders), a video's frames or
    those of the webcam of that number. most: how many at most; None is all, and 100 of a webcam.

    Raises DataError at once when there is nothing to read, and on the way for an image that cannot be decoded.
    """
    if most is not None and most < 1:
        raise DataError(f"frames is {most}; at least 1 is needed")
    if source.name.isdigit() and not source.exists():
        return islice(_frames(Path(f"webcam{source.name}"), int(source.name)), most or _WEBCAM_FRAMES)
    return islice(_stored(source), most)


def _stored(source: Path) -> Iterator[Picture]:
    if source.is_dir():
        files = sorted(file for file in source.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
        if not files:
            raise DataError(f"{source}: holds no image ({' '.join(sorted(IMAGE_SUFFIXES))})")
        return _images(files)
    if not source.is_file():
        raise DataError(f"{source}: no such file or folder")
    if source.suffix.lower() in VIDEO_SUFFIXES:
        return _frames(source, str(source))
    return _images([source])


def _images(files: list[Path]) -> Iterator[Picture]:
    stems = Counter(file.stem for file in files)
    for file in files:
        data = np.frombuffer(file.read_bytes(), np.uint8)
        bgr = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
        if bgr is None:
            raise DataError(f"{file}: cannot be decoded as an image")
        name = file.stem if stems[file.stem] == 1 else file.name  # a.jpg and a.png must not share an overlay
        yield Picture(file.name, f"{name}_overlay.jpg", _rgb(bgr))


def _frames(file: Path, origin: str | int) -> Iterator[Picture]:
    video = cv2.VideoCapture(origin)
    index = 0
    try:
        while (frame := video.read())[0]:
            name = f"{file.stem}_{index:06d}"
            yield Picture(f"{name}.jpg", f"{name}_overlay.jpg", _rgb(frame[1]))
            index += 1
    finally:
        video.release()
    if not index:
        raise DataError(f"{file}: no picture comes out of it")


def _rgb(bgr: Any) -> Image:
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def draw(rgb: Image, found: Detections, outlines: list[list[Polygon]]) -> Image:
    """The image with every object's mask, outline and text (class, score, quality). rgb, result: uint8 [H, W, 3]."""
    canvas = rgb.copy()
    masks = found.masks()
    unit = max(rgb.shape[0], rgb.shape[1]) / 640  # line and letter size grow with the image
    thick = max(1, round(1.5 * unit))
    for row in range(len(found)):
        colour = _COLOURS[row % len(_COLOURS)]
        inside = masks[row]
        canvas[inside] = ((1 - _FILL) * canvas[inside] + _FILL * np.array(colour)).astype(np.uint8)
        # OpenCV counts from the centre of the first pixel
        rings = [np.round(ring - 0.5).astype(np.int32) for polygon in outlines[row] for ring in polygon.rings]
        cv2.polylines(canvas, rings, True, colour, thick, cv2.LINE_AA)
    for row in range(len(found)):
        text = f"{found.class_names[found.labels[row]]} {found.scores[row]:.2f} q{found.quality[row]:.2f}"
        _write_text(canvas, text, found.boxes[row], _COLOURS[row % len(_COLOURS)], 0.45 * unit)
    return canvas


def _write_text(canvas: Image, text: str, box: NDArray[np.float32], colour: tuple[int, int, int], scale: float) -> None:
    thick = max(1, round(2 * scale))
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    x = int(np.clip(box[0], 0, max(canvas.shape[1] - width - 4, 0)))
    y = int(np.clip(box[1], height + 6, max(canvas.shape[0] - 2, height + 6)))
    cv2.rectangle(canvas, (x, y - height - 6), (x + width + 4, y), colour, -1)
    cv2.putText(canvas, text, (x + 2, y - 4), cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), thick, cv2.LINE_AA)


def _jpeg(rgb: Image) -> bytes:
    return bytes(cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90])[1])
