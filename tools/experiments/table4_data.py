#!/usr/bin/env python3
"""Real photographs for Table 4: vehicles and people of two COCO-format folders.

    tools/experiments/table4_data.py COCO_SMALL COAD_VEHICLES OUT

COCO's cars, buses and trucks become "vehicle", as the street photographs call them. Every other
class is skipped; photographs of nothing else stay, as background. Images are hard links where
possible: do not edit them.
"""

import sys
from pathlib import Path
from typing import Any

from cohdc_train.data.coco import read_split
from cohdc_train.data.layout import find_split, read_json
from cohdc_train.errors import DataError
from cohdc_train.files import link_or_copy, new_folder, write_json

CLASSES = {
    "person": "person",
    "motorcycle": "motorcycle",
    **dict.fromkeys(("vehicle", "car", "bus", "truck"), "vehicle"),
}
IDS = {name: i for i, name in enumerate(sorted(set(CLASSES.values())), start=1)}


def main() -> None:
    """Read, join, write, read back."""
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    *sources, out = (Path(argument).resolve() for argument in sys.argv[1:])
    with new_folder(out) as draft:
        (draft / "images").mkdir()
        for name in ("train", "val"):
            joined: dict[str, list[Any]] = {
                "images": [],
                "annotations": [],
                "categories": [{"id": i, "name": name} for name, i in IDS.items()],
            }
            for source in sources:
                add(joined, source, name, draft / "images")
            write_json(draft / f"instances_{name}.json", joined)
            split = read_split(name, find_split(draft, name))
            num_objects = sum(len(image.objects) for image in split.images)
            print(f"{name}: {len(split.images)} images, {num_objects} objects")


def add(joined: dict[str, list[Any]], source: Path, name: str, images: Path) -> None:
    """Append a source's split to a COCO dict under new ids and file names, and link its images."""
    files = find_split(source, name)
    content = read_json(files.annotations)
    classes = {
        row["id"]: IDS[CLASSES[row["name"]]]
        for row in content["categories"]
        if row["name"] in CLASSES
    }
    ids: dict[int, int] = {}
    for row in content["images"]:
        ids[row["id"]] = len(joined["images"]) + 1
        path = files.images / row["file_name"]
        file_name = f"{source.name}_{path.name}"
        joined["images"].append(row | {"id": ids[row["id"]], "file_name": file_name})
        link_or_copy(path, images / file_name)
    for row in content["annotations"]:
        if row["category_id"] in classes:
            new = {"id": len(joined["annotations"]) + 1, "category_id": classes[row["category_id"]]}
            joined["annotations"].append(row | new | {"image_id": ids[row["image_id"]]})


if __name__ == "__main__":
    try:
        main()
    except DataError as error:
        sys.exit(str(error))
