"""Toy folders that are each broken in one way, with the issue that doctor has to find."""

import copy
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import coco_toys as toys
import cv2
import numpy as np
from PIL import Image
from pycocotools import mask as rle

HEIGHT, WIDTH = toys.HEIGHT, toys.WIDTH
Change = Callable[[dict[str, Any], Path], None]


class Broken(NamedTuple):
    """A way to break a folder.

    Attributes:
        change: breaks the training split's dict, or files below the root.
        kind: the issue.
        fixed: `--fix` removes the issue.
    """

    change: Change
    kind: str
    fixed: bool = True


def _set(index: int, **values: Any) -> Change:
    """Set values of an annotation."""
    return lambda content, root: content["annotations"][index].update(values)


def _first_image(**values: Any) -> Change:
    return lambda content, root: content["images"][0].update(values)


def _add(key: str, row: Any) -> Change:
    return lambda content, root: content[key].append(row)


def _again(key: str, **values: Any) -> Change:
    """Repeat the first row with other values."""
    return lambda content, root: content[key].append(content[key][0] | values)


def _file(write: Callable[[Path], object]) -> Change:
    """Change the first training image's file."""
    return lambda content, root: write(root / "images" / content["images"][0]["file_name"])  # type: ignore[func-returns-value]


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-400])


def _jpeg(turned: int = 1, mode: str = "RGB", cut: int = 0) -> Change:
    """Replace the first training image by a JPEG: turned by EXIF, of a mode, or truncated."""

    def change(content: dict[str, Any], root: Path) -> None:
        row = content["images"][0]
        image_file = Image.open(root / "images" / row["file_name"]).convert(mode)
        row["file_name"] = "shot.jpg"
        exif = Image.Exif()
        exif[0x0112] = turned
        image_file.save(root / "images" / "shot.jpg", exif=exif, quality=95)
        path = root / "images" / "shot.jpg"
        path.write_bytes(path.read_bytes()[: len(path.read_bytes()) - cut])

    return change


def _turned_by_exif(content: dict[str, Any], root: Path) -> None:
    """Annotate the image as viewers show it, HEIGHT x WIDTH, while its pixels are turned."""
    row = content["images"][0]
    image_file = Image.open(root / "images" / row["file_name"]).transpose(Image.Transpose.ROTATE_90)
    exif = Image.Exif()
    exif[0x0112] = 6
    image_file.save(root / "images" / "shot.jpg", exif=exif)
    row["file_name"] = "shot.jpg"


def _swapped_size(content: dict[str, Any], root: Path) -> None:
    """Swap width and height in the JSON; the contours fit the file."""
    content["images"][0].update(width=HEIGHT, height=WIDTH)


def _resized(content: dict[str, Any], root: Path) -> None:
    path = root / "images" / content["images"][0]["file_name"]
    cv2.imwrite(str(path), np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8))


def _leak(content: dict[str, Any], root: Path) -> None:
    """Add a validation image to the training images, mirrored and a little brighter."""
    shown = cv2.imread(str(root / "images" / "val_1.png"))
    name = content["images"][0]["file_name"]
    cv2.imwrite(str(root / "images" / name), cv2.add(shown[:, ::-1].copy(), (9, 9, 9, 0)))


def _listed_twice(content: dict[str, Any], root: Path) -> None:
    content["images"].append(content["images"][0] | {"id": 77})
    content["annotations"].append(toys.rectangle(77, 10, (40, 2, 10, 10), 901))


def _many(content: dict[str, Any], root: Path) -> None:
    for i in range(500):
        box = (i % 50, i // 50 * 4, 3, 3)
        content["annotations"].append(toys.rectangle(1, 10, box, 1000 + i))


def _box_twice_as_far(content: dict[str, Any], root: Path) -> None:
    x, y, w, h = content["annotations"][0]["bbox"]
    content["annotations"][0]["bbox"] = [x + 30, y + 10, w, h]


def _corners(content: dict[str, Any], root: Path) -> None:
    for row in content["annotations"]:
        x, y, w, h = row["bbox"]
        row["bbox"] = [x, y, x + w, y + h]


def _flat(content: dict[str, Any], root: Path) -> None:
    row = content["annotations"][0]
    row["segmentation"] = row["segmentation"][0]


def _class_only_in_train(content: dict[str, Any], root: Path) -> None:
    content["categories"] = [*content["categories"], {"id": 30, "name": "cart"}]
    content["annotations"].append(toys.rectangle(1, 30, (44, 2, 10, 10), 901))


def _second_person(content: dict[str, Any], root: Path) -> None:
    content["categories"] = [*content["categories"], {"id": 11, "name": "person"}]
    content["annotations"].append(toys.rectangle(1, 11, (44, 2, 10, 10), 901))


def _huge(content: dict[str, Any], root: Path) -> None:
    cv2.imwrite(str(root / "images" / "huge.jpg"), np.full((4000, 12000, 3), 90, np.uint8))
    content["images"].append({"id": 50, "file_name": "huge.jpg", "width": 12000, "height": 4000})
    content["annotations"].append(toys.rectangle(50, 10, (3000, 500, 2000, 3000), 901))


def _rle(counts: Any, size: tuple[int, int] = (HEIGHT, WIDTH)) -> dict[str, Any]:
    return {"size": list(size), "counts": counts}


_MASK = np.asfortranarray(np.pad(np.ones((20, 10), np.uint8), ((4, HEIGHT - 24), (3, WIDTH - 13))))
_GOOD = rle.encode(_MASK)["counts"].decode()
_CROSSING = [[5, 5, 25, 25, 25, 5, 5, 30]]

BROKEN: dict[str, Broken] = {
    "category without a name": Broken(_add("categories", {"id": 30}), "category-broken"),
    "category id for two names": Broken(
        _add("categories", {"id": 10, "name": "cart"}), "category-id-twice"
    ),
    "two ids for one name": Broken(_second_person, "category-name-twice"),
    "category nobody uses": Broken(
        _add("categories", {"id": 30, "name": "cart"}), "classes-differ", fixed=False
    ),
    "class of one split only": Broken(_class_only_in_train, "classes-differ", fixed=False),
    "image without a width": Broken(lambda c, r: c["images"][0].pop("width"), "image-broken"),
    "image id twice": Broken(_again("images", file_name="train_2.png"), "image-id-twice"),
    "image file listed twice": Broken(_listed_twice, "image-listed-twice"),
    "image file missing": Broken(_file(Path.unlink), "image-missing"),
    "image file of text": Broken(
        _file(lambda path: path.write_text("<html>404</html>")), "image-corrupt"
    ),
    "image file empty": Broken(_file(lambda path: path.write_bytes(b"")), "image-corrupt"),
    "PNG cut": Broken(_file(_cut), "image-truncated"),
    "JPEG cut": Broken(_jpeg(cut=300), "image-truncated"),
    "JPEG turned by EXIF": Broken(_turned_by_exif, "image-turned"),
    "JPEG upside down by EXIF": Broken(_jpeg(turned=3), "image-turned"),
    "JPEG of EXIF, annotated unturned": Broken(_jpeg(turned=6), "image-exif"),
    "CMYK": Broken(_jpeg(mode="CMYK"), "image-color"),
    "width and height swapped": Broken(_swapped_size, "image-size"),
    "image resized, annotations not": Broken(_resized, "image-size"),
    "image of 48 megapixels": Broken(_huge, "image-huge"),
    "image without objects": Broken(
        _add("images", {"id": 50, "file_name": "train_2.png", "width": WIDTH, "height": HEIGHT}),
        "image-listed-twice",
    ),
    "500 objects in an image": Broken(_many, "image-crowded"),
    "annotation of text": Broken(_add("annotations", "person"), "annotation-broken"),
    "annotation of many images": Broken(_set(0, image_id=[1, 2]), "annotation-broken"),
    "annotation of an unknown image": Broken(_set(0, image_id=99), "annotation-orphan"),
    "annotation of an unknown category": Broken(_set(0, category_id=99), "annotation-category"),
    "annotation id twice": Broken(_set(0, id=2), "annotation-id"),
    "annotation without an id": Broken(lambda c, r: c["annotations"][0].pop("id"), "annotation-id"),
    "object annotated twice": Broken(_again("annotations", id=900), "annotation-twice"),
    "box without a contour": Broken(_set(0, segmentation=[]), "contour-missing"),
    "contour of text": Broken(_set(0, segmentation="polygon"), "contour-format"),
    "RLE without counts": Broken(_set(0, segmentation={"size": [HEIGHT, WIDTH]}), "contour-format"),
    "polygon not in a list": Broken(_flat, "contour-flat"),
    "polygon of two points": Broken(_set(0, segmentation=[[3, 4, 19, 28]]), "contour-short"),
    "polygon of an odd count": Broken(
        _set(0, segmentation=[[3, 4, 19, 4, 19, 28, 3]]), "contour-odd"
    ),
    "polygon with NaN": Broken(
        _set(0, segmentation=[[3, 4, 19, 4, float("nan"), 28]]), "contour-number"
    ),
    "polygon with infinity": Broken(
        _set(0, segmentation=[[3, 4, 19, 4, float("inf"), 28]]), "contour-number"
    ),
    "polygon to the moon": Broken(
        _set(0, segmentation=[[3, 4, 1e9, 4, 19, 28]], bbox=None), "contour-outside"
    ),
    "polygon of which a part is broken": Broken(
        _set(0, segmentation=[[3, 4, 19, 4, 19, 28, 3, 28], [5, 5, 9, 9]]), "contour-short"
    ),
    "polygon on a line": Broken(
        _set(0, segmentation=[[3, 4, 9, 4, 19, 4]], bbox=[3, 4, 16, 1]), "contour-empty"
    ),
    "polygon outside": Broken(
        _set(0, segmentation=[[80, 4, 99, 4, 99, 28, 80, 28]], bbox=[80, 4, 19, 24]),
        "contour-empty",
    ),
    "polygon reaches out": Broken(
        _set(0, segmentation=[[-9, 4, 19, 4, 19, 28, -9, 28]], bbox=[-9, 4, 28, 24], area=456),
        "contour-outside",
    ),
    "polygon crosses itself": Broken(
        _set(0, segmentation=_CROSSING, bbox=[5, 5, 20, 25]), "contour-crossing"
    ),
    "RLE empty": Broken(_set(0, segmentation=_rle([HEIGHT * WIDTH])), "contour-empty"),
    "RLE of another size": Broken(
        _set(0, segmentation=_rle([WIDTH * HEIGHT], (WIDTH, HEIGHT))), "rle-size"
    ),
    "RLE too short": Broken(_set(0, segmentation=_rle([5, 5])), "rle-counts"),
    "RLE text damaged": Broken(_set(0, segmentation=_rle(_GOOD[:-3])), "rle-counts"),
    "box without width": Broken(_set(0, bbox=[3, 4, 0, 24]), "box-degenerate"),
    "box of text": Broken(_set(0, bbox=["3", "4", "16", "24"]), "box-degenerate"),
    "box inverted": Broken(_set(0, bbox=[19, 28, -16, -24]), "box-inverted"),
    "boxes of corners": Broken(_corners, "box-corners"),
    "box reaches out": Broken(_set(1, bbox=[30, 21, 40, 14]), "box-outside"),
    "box elsewhere": Broken(_box_twice_as_far, "box-disagrees"),
    "box missing": Broken(lambda c, r: c["annotations"][0].pop("bbox"), "box-missing"),
    "area of another unit": Broken(_set(0, area=3.84), "area-wrong"),
    "area of text": Broken(_set(0, area="large"), "area-wrong"),
    "object of one pixel": Broken(
        _set(0, segmentation=[[30, 5, 31, 5, 31, 6, 30, 6]], bbox=[30, 5, 1, 1], area=1),
        "object-tiny",
    ),
    "crowd": Broken(_set(0, iscrowd=1), "crowd"),
    "crowd as text": Broken(_set(0, iscrowd="1"), "crowd"),
    "validation image in train": Broken(_leak, "leak", fixed=False),
}


def build(root: Path, name: str) -> Path:
    """Draw the folder that is broken in the named way."""
    toys.folder(root)
    content = copy.deepcopy(toys.content(root / "images", "train", 6))
    BROKEN[name].change(content, root)
    toys.write(root / "instances_train.json", content)
    return root


def whole(root: Path) -> Path:
    """Draw the same folder without a fault."""
    shutil.rmtree(root, ignore_errors=True)
    return toys.folder(root)
