"""Toy COCO-format folders, drawn: colored rectangles on noise."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

HEIGHT, WIDTH = 48, 64
CATEGORIES = [{"id": 20, "name": "car"}, {"id": 10, "name": "person"}]
COLORS = {10: (250, 60, 60), 20: (60, 60, 250)}  # RGB


def rectangle(
    image_id: int, category: int, box: tuple[int, int, int, int], number: int
) -> dict[str, Any]:
    x, y, w, h = box
    polygon = [x, y, x + w, y, x + w, y + h, x, y + h]
    row = {
        "id": number,
        "image_id": image_id,
        "category_id": category,
        "bbox": list(box),
        "area": w * h,
        "iscrowd": 0,
    }
    return {**row, "segmentation": [polygon]}


def draw_image(path: Path, rows: list[dict[str, Any]], seed: int) -> None:
    pixels = np.random.default_rng(seed).integers(0, 100, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    for row in rows:
        x, y, w, h = (int(v) for v in row["bbox"])
        pixels[y : y + h, x : x + w] = COLORS.get(row["category_id"], (0, 200, 0))
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), pixels[:, :, ::-1])


def content(images: Path, name: str, count: int) -> dict[str, Any]:
    """Draw `count` images with a person and a car each, and return their COCO dict.

    Those of "val" look different.
    """
    rows, files = [], []
    other = name == "val"
    for i in range(1, count + 1):
        people = rectangle(
            i, 10, (34 + i, 20, 16, 24) if other else (2 + i, 4, 16, 24), len(rows) + 1
        )
        cars = rectangle(
            i, 20, (4, 4 + i % 4, 24, 14) if other else (30, 20 + i % 4, 24, 14), len(rows) + 2
        )
        file_name = f"{name}_{i}.png"
        draw_image(images / file_name, [people, cars], 1000 * other + i)
        rows += [people, cars]
        files.append({"id": i, "file_name": file_name, "height": HEIGHT, "width": WIDTH})
    return {"images": files, "annotations": rows, "categories": CATEGORIES}


def write(path: Path, value: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value), encoding="utf-8")
    return path


def folder(root: Path, train: int = 6, val: int = 2) -> Path:
    """Write `images/` and `instances_{train,val}.json`."""
    for name, count in (("train", train), ("val", val)):
        write(root / f"instances_{name}.json", content(root / "images", name, count))
    return root
