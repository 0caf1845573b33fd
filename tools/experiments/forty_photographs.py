#!/usr/bin/env python3
"""Scores of a new user's forty photographs in labelme format after ten minutes on one core.

    tools/experiments/forty_photographs.py --data HUMAN_MATTE --out DIR [--photographs 40]
    [--minutes 10] [--seed 0]

Writes DIR/photos as labelme does (train/ with the chosen photographs, val/ with all of the
validation split, one JSON each), converts it, trains with README's command, and prints the scores
of best.ckpt.
"""

import argparse
import json
import os
import random
import subprocess
import sys
from pathlib import Path
from typing import Any


def main() -> int:
    """Write the folder, convert, train, score."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="COCO-format folder with polygons")
    parser.add_argument("--out", type=Path, required=True, help="new folder")
    parser.add_argument("--photographs", type=int, default=40)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    photos, data, run = (arguments.out / name for name in ("photos", "data", "fit"))

    write_labelme(arguments.data, "train", photos / "train", arguments.photographs, arguments.seed)
    write_labelme(arguments.data, "val", photos / "val", None, arguments.seed)
    cohdc("data", "convert", "labelme", str(photos), str(data))
    budget = (f"--minutes={arguments.minutes:g}", f"--seed_everything={arguments.seed}")
    cohdc(
        "fit",
        str(data),
        *budget,
        f"--out={run}",
        "--data.workers=0",
        "--trainer.enable_progress_bar=false",
    )
    cohdc(
        "validate", str(run / "best.ckpt"), str(data), "--out", str(arguments.out / "scores.json")
    )
    return 0


def write_labelme(data: Path, split: str, folder: Path, count: int | None, seed: int) -> None:
    """Write a split, or `count` of its images, as a labelme folder with links to the images."""
    coco = json.loads((data / f"instances_{split}.json").read_text(encoding="utf-8"))
    names = {row["id"]: row["name"] for row in coco["categories"]}
    images = sorted(coco["images"], key=lambda row: row["id"])
    chosen = images if count is None else random.Random(seed).sample(images, count)
    folder.mkdir(parents=True)
    for image in chosen:
        source = (data / "images" / image["file_name"]).resolve()
        (folder / source.name).symlink_to(source)
        rows = [row for row in coco["annotations"] if row["image_id"] == image["id"]]
        content = {
            "version": "5.5.0",
            "imagePath": source.name,
            "imageData": None,
            "imageHeight": image["height"],
            "imageWidth": image["width"],
            "shapes": [
                shape for number, row in enumerate(rows) for shape in shapes_of(row, names, number)
            ],
        }
        (folder / source.with_suffix(".json").name).write_text(
            json.dumps(content), encoding="utf-8"
        )


def shapes_of(row: dict[str, Any], names: dict[int, str], number: int) -> list[dict[str, Any]]:
    """Return labelme's shapes of an annotation: a polygon for each part, under one group."""
    shape = {"label": names[row["category_id"]], "shape_type": "polygon", "group_id": number}
    return [
        {**shape, "points": list(zip(part[::2], part[1::2], strict=True))}
        for part in row["segmentation"]
    ]


def cohdc(*arguments: str) -> None:
    """Run a command of the package on one thread."""
    command = [sys.executable, "-m", "cohdc_train", *arguments]
    subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})


if __name__ == "__main__":
    raise SystemExit(main())
