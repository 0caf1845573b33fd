#!/usr/bin/env python3
"""One COCO-format folder of people for the shipped networks' training.

    tools/experiments/person_data.py --data COCO_SMALL COCO_PEOPLE --out DIR [--held 150] [--seed 0]

Merges the training splits of the folders, person annotations only, into DIR/images (links) and
DIR/instances_train.json. --held images of the last folder become DIR/instances_val.json instead:
choices are made on them, because the validation split of the first folder is what the cards report.
"""

import argparse
import json
import random
from pathlib import Path
from typing import Any

CLASS = "person"


def main() -> int:
    """Merge, hold out, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="COCO-format folders")
    parser.add_argument("--out", type=Path, required=True, help="new folder")
    parser.add_argument(
        "--held", type=int, default=150, help="images of the last folder to choose by"
    )
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    (arguments.out / "images").mkdir(parents=True)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    first_of_last = 0
    for folder in arguments.data:
        first_of_last = len(images)
        add_folder(folder, arguments.out / "images", images, annotations)
    candidates = [image["id"] for image in images[first_of_last:]]
    held = set(random.Random(arguments.seed).sample(candidates, arguments.held))
    for split, wanted in (("train", False), ("val", True)):
        content = {
            "images": [image for image in images if (image["id"] in held) == wanted],
            "annotations": [row for row in annotations if (row["image_id"] in held) == wanted],
            "categories": [{"id": 1, "name": CLASS}],
        }
        (arguments.out / f"instances_{split}.json").write_text(
            json.dumps(content), encoding="utf-8"
        )
        print(
            f"{split}: {len(content['images'])} images, {len(content['annotations'])} annotations"
        )
    return 0


def add_folder(
    folder: Path, target: Path, images: list[dict[str, Any]], annotations: list[dict[str, Any]]
) -> None:
    """Append a folder's training images and people under new ids, and link its images."""
    coco = json.loads((folder / "instances_train.json").read_text(encoding="utf-8"))
    person = next(row["id"] for row in coco["categories"] if row["name"] == CLASS)
    new_ids: dict[int, int] = {}
    for image in sorted(coco["images"], key=lambda row: row["id"]):
        new_ids[image["id"]] = len(images) + 1
        name = f"{folder.name}_{Path(image['file_name']).name}"
        (target / name).symlink_to((folder / "images" / image["file_name"]).resolve())
        size = {"height": image["height"], "width": image["width"]}
        images.append({"id": len(images) + 1, "file_name": name, **size})
    for row in coco["annotations"]:
        if row["category_id"] == person:
            owner = {
                "id": len(annotations) + 1,
                "image_id": new_ids[row["image_id"]],
                "category_id": 1,
            }
            annotations.append(row | owner)


if __name__ == "__main__":
    raise SystemExit(main())
