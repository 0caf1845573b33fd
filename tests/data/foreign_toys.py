"""Toy folders in other annotation formats, written by hand: two classes, four images of noise."""

import base64
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

HEIGHT, WIDTH = 48, 64
NAMES = ("a", "b", "c", "d")
PERSON = [5.0, 4.0, 25.0, 6.0, 22.0, 30.0, 7.0, 28.0]  # a polygon, px
CAR = (30, 20, 54, 34)  # x0 y0 x1 y1, px


def draw_image(
    path: Path, seed: int, size: tuple[int, int] = (HEIGHT, WIDTH), exif: int = 1
) -> Path:
    """Write an image of noise. exif: the orientation that a JPEG gets."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(seed).integers(0, 255, (*size, 3), dtype=np.uint8)
    tags = Image.Exif()
    tags[0x0112] = exif
    Image.fromarray(cv2.blur(pixels, (3, 3))).save(path, **({"exif": tags} if exif != 1 else {}))
    return path


def write(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def box_mask(x0: int, y0: int, x1: int, y1: int) -> NDArray[np.uint8]:
    """Return [HEIGHT, WIDTH], 1 inside the box."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[y0:y1, x0:x1] = 1
    return mask


def disk_mask(cx: float, cy: float, rx: float, ry: float, theta: float = 0.0) -> NDArray[np.uint8]:
    """Return [HEIGHT, WIDTH], 1 where a pixel's center lies inside the ellipse."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    along = (x - cx) * np.cos(theta) + (y - cy) * np.sin(theta)
    across = (y - cy) * np.cos(theta) - (x - cx) * np.sin(theta)
    return ((along / rx) ** 2 + (across / ry) ** 2 <= 1).astype(np.uint8)


def base64_png(values: NDArray[Any]) -> str:
    file = io.BytesIO()
    Image.fromarray(values).save(file, format="PNG")
    return base64.b64encode(file.getvalue()).decode()


def points(flat: list[float]) -> list[list[float]]:
    return [list(pair) for pair in zip(flat[::2], flat[1::2], strict=True)]


def shape(label: str, kind: str, flat: list[float], **more: Any) -> dict[str, Any]:
    """Return one of labelme's shapes."""
    return {
        "label": label,
        "points": points(flat),
        "group_id": None,
        "shape_type": kind,
        "flags": {},
    } | more


def labelme_file(path: Path, shapes: list[Any], image: str | None = None, **more: Any) -> Path:
    content = {
        "version": "5.5.0",
        "flags": {},
        "shapes": shapes,
        "imagePath": image or f"{path.stem}.png",
    }
    return write(
        path, content | {"imageData": None, "imageHeight": HEIGHT, "imageWidth": WIDTH} | more
    )


def labelme(root: Path) -> Path:
    for seed, name in enumerate(NAMES):
        draw_image(root / f"{name}.png", seed)
        labelme_file(
            root / f"{name}.json",
            [shape("person", "polygon", PERSON), shape("car", "rectangle", [30, 20, 54, 34])],
        )
    return root


def region(kind: str, attributes: dict[str, Any], **shape_attributes: Any) -> dict[str, Any]:
    """Return one of VIA's regions."""
    return {"shape_attributes": {"name": kind} | shape_attributes, "region_attributes": attributes}


def person_and_car(key: str = "kind") -> list[dict[str, Any]]:
    xs, ys = PERSON[::2], PERSON[1::2]
    return [
        region("polygon", {key: "person"}, all_points_x=xs, all_points_y=ys),
        region("rect", {key: "car"}, x=30, y=20, width=24, height=14),
    ]


def via(root: Path, regions: list[dict[str, Any]] | None = None) -> Path:
    """Write an export of VIA 2."""
    content = {}
    for seed, name in enumerate(NAMES):
        draw_image(root / f"{name}.png", seed)
        own = regions if regions is not None and name == "a" else person_and_car()
        content[f"{name}.png99"] = {
            "filename": f"{name}.png",
            "size": 99,
            "regions": own,
            "file_attributes": {},
        }
    write(root / "via.json", content)
    return root


def yolo_row(index: int, polygon: list[float]) -> str:
    values = (value / (HEIGHT if i % 2 else WIDTH) for i, value in enumerate(polygon))
    return " ".join([str(index), *(f"{value:.6f}" for value in values)])


def yolo(
    root: Path, yaml: str = "path: .\ntrain: images/train\nval: images/val\nnames: [person, car]\n"
) -> Path:
    write(root / "data.yaml", yaml)
    for seed, name in enumerate(NAMES):
        split = "val" if name == "d" else "train"
        draw_image(root / "images" / split / f"{name}.png", seed)
        x0, y0, x1, y1 = CAR
        rows = [yolo_row(0, PERSON), yolo_row(1, [x0, y0, x1, y0, x1, y1, x0, y1])]
        write(root / "labels" / split / f"{name}.txt", "\n".join(rows) + "\n")
    return root


def palette_png(path: Path, values: NDArray[Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(values.astype(np.uint8))
    image.putpalette([value for i in range(256) for value in voc_color(i)])
    image.save(path)
    return path


def voc_color(index: int) -> tuple[int, int, int]:
    """Return the color of a class by the formula of the devkit."""
    known = {0: (0, 0, 0), 1: (128, 0, 0), 2: (0, 128, 0), 7: (128, 128, 128), 15: (192, 128, 128)}
    return known.get(index, (224, 224, 192) if index == 255 else (index, 3, 5))


def voc_labels(void: bool = True) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return pixels of objects (1 person, 2 car) and of VOC's classes (15, 7).

    A void line runs around the car.
    """
    x0, y0, x1, y1 = CAR
    objects = box_mask(5, 4, 25, 30) + 2 * box_mask(*CAR)
    classes = 15 * box_mask(5, 4, 25, 30) + 7 * box_mask(*CAR)
    if void:
        line = box_mask(x0 - 1, y0 - 1, x1 + 1, y1 + 1) - box_mask(*CAR)
        objects[line > 0] = classes[line > 0] = 255
    return objects, classes


def voc(root: Path) -> Path:
    for seed, name in enumerate(NAMES):
        draw_image(root / "JPEGImages" / f"{name}.jpg", seed)
        objects, classes = voc_labels()
        palette_png(root / "SegmentationObject" / f"{name}.png", objects)
        palette_png(root / "SegmentationClass" / f"{name}.png", classes)
    write(root / "ImageSets" / "Segmentation" / "train.txt", "a\nb\nc\n")
    write(root / "ImageSets" / "Segmentation" / "val.txt", "d\n")
    return root
