"""Photographs with an EXIF orientation: labels lie on the objects, wherever an image is read."""

import io
import json
import tempfile
from pathlib import Path
from typing import Any

import coco_toys as coco
import foreign_toys as foreign
import numpy as np
import pytest
from conversion import converted, image_of, masks_of
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image, ImageOps

from cohdc_train.cli import main
from cohdc_train.data.annotations import read_image
from cohdc_train.data.coco import CocoImage, find_split, read_split
from cohdc_train.data.datamodule import CocoDataModule
from cohdc_train.data.doctor import sample_grid as grid
from cohdc_train.exporter.sample_images import read_samples
from cohdc_train.images import orientation_of, read_rgb
from cohdc_train.prediction.image_sources import read_images

Captured = pytest.CaptureFixture[str]
HEIGHT, WIDTH = 96, 128
BOX = (16, 8, 40, 24)  # of the object in the upright image: x y width height, px; off the center
COLOR, GROUND = (210, 40, 40), (30, 60, 120)
ALL = range(1, 9)
QUARTERS = (5, 6, 7, 8)
SIZES = st.tuples(st.integers(1, 40), st.integers(1, 40))
HEADS = st.sampled_from([b"", b"Exif\0\0", b"Exif\0\0II*\0\x08\0\0\0\1\0\x12\1"])
TURN = Image.Transpose
# How an upright image becomes the stored one, for each orientation.
STORED = {
    2: TURN.FLIP_LEFT_RIGHT,
    3: TURN.ROTATE_180,
    4: TURN.FLIP_TOP_BOTTOM,
    5: TURN.TRANSPOSE,
    6: TURN.ROTATE_90,
    7: TURN.TRANSVERSE,
    8: TURN.ROTATE_270,
}


def draw(box: tuple[int, ...] = BOX) -> Image.Image:
    """Draw an image with one object in it."""
    x, y, w, h = box
    pixels = np.full((HEIGHT, WIDTH, 3), GROUND, np.uint8)
    pixels[y : y + h, x : x + w] = COLOR
    return Image.fromarray(pixels)


def save(upright: Image.Image, path: Path, orientation: int) -> Path:
    """Write an image that its EXIF orientation turns upright."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = upright.transpose(STORED[orientation]) if orientation in STORED else upright
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored.save(path, exif=exif, **({"quality": 95} if path.suffix in (".jpg", ".webp") else {}))
    return path


def folder(root: Path, orientations: Any = ALL, as_stored: bool = False) -> Path:
    """Write a folder with a training image per orientation and two plain validation images.

    as_stored: the labels are of the stored pixels, not of the upright image.
    """
    for split, kinds in (("train", orientations), ("val", (1, 1))):
        images: list[Any] = []
        rows: list[Any] = []
        for number, kind in enumerate(kinds, 1):
            box, size = list(BOX), (WIDTH, HEIGHT)
            if split == "val":
                box[0] += 20 * number
            file = save(draw(tuple(box)), root / "images" / f"{split}_{kind}_{number}.jpg", kind)
            if as_stored and split == "train":
                box, size = stored_place(file)
            shape = {"width": size[0], "height": size[1]}
            images.append({"id": number, "file_name": file.name} | shape)
            rows.append(coco.rectangle(number, 1, tuple(box), number))
        content = {"images": images, "annotations": rows}
        content["categories"] = [{"id": 1, "name": "cart"}]
        foreign.write(root / f"instances_{split}.json", content)
    return root


def stored_place(file: Path) -> tuple[list[int], tuple[int, int]]:
    """Return the object's box in the stored pixels, and their size (width, height)."""
    with Image.open(file) as image:
        inside = np.asarray(image.convert("RGB"))[..., 0] > 120
    rows, columns = np.nonzero(inside.any(axis=1))[0], np.nonzero(inside.any(axis=0))[0]
    box = [int(columns[0]), int(rows[0]), int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1]
    return box, (inside.shape[1], inside.shape[0])


def train_images(root: Path) -> tuple[CocoImage, ...]:
    return read_split("train", find_split(root, "train")).images


def assert_labeled(pixels: NDArray[np.uint8], mask: NDArray[Any]) -> None:
    """Assert that the mask covers the object, and that nothing else has its color."""
    assert np.abs(pixels[mask > 0].mean(axis=0) - COLOR).max() < 15
    assert np.abs(pixels[mask == 0].mean(axis=0) - GROUND).max() < 15


def doctor(root: Path, *options: str) -> tuple[int, dict[str, list[str]]]:
    """Run the doctor, and return the exit code and the training split's issues."""
    code = main(["data", "doctor", str(root), "--out", str(root / "seen"), *options])
    return code, json.loads((root / "seen" / "issues.json").read_text())["train"]


def test_labels_of_the_upright_image_lie_on_the_object(tmp_path: Path, capsys: Captured) -> None:
    root = folder(tmp_path / "a")
    for image in train_images(root):
        pixels = read_image(image)
        assert pixels.shape == (HEIGHT, WIDTH, 3)
        assert_labeled(pixels, image.objects[0].mask(HEIGHT, WIDTH))
    code, found = doctor(root, "--fix", str(tmp_path / "fixed"))
    assert code == 0
    assert len(found["image-turned"]) == 7
    assert "image-exif" not in found
    assert "note         7  image turned upright by its EXIF orientation" in capsys.readouterr().out
    assert json.loads((tmp_path / "fixed" / "removed.json").read_text()) == {"train": [], "val": []}
    assert len(json.loads((tmp_path / "fixed" / "instances_train.json").read_text())["images"]) == 8


def test_labels_of_the_stored_pixels_lie_on_the_object(tmp_path: Path, capsys: Captured) -> None:
    """The annotated size tells that an image turned by 90 degrees was annotated unturned."""
    root = folder(tmp_path / "a", QUARTERS, as_stored=True)
    for image in train_images(root):
        pixels = read_image(image)
        assert pixels.shape == (WIDTH, HEIGHT, 3)
        assert_labeled(pixels, image.objects[0].mask(image.height, image.width))
    code, found = doctor(root)
    assert code == 0
    assert len(found["image-exif"]) == 4
    assert "image-turned" not in found
    assert "note         4  EXIF says turned" in capsys.readouterr().out


@pytest.mark.parametrize("as_stored", [False, True])
def test_training_and_validation_read_image_as_annotated(tmp_path: Path, as_stored: bool) -> None:
    root = folder(tmp_path / "a", QUARTERS if as_stored else ALL, as_stored)
    (root / "instances_val.json").write_bytes((root / "instances_train.json").read_bytes())
    data = CocoDataModule(root, canvas=(HEIGHT, WIDTH), batch_size=1, workers=0)
    data.setup("fit")
    count = 0
    for batch in data.train_dataloader():
        pixels = batch.images[0].permute(1, 2, 0).numpy()
        (mask,) = batch.targets[0]["masks"].numpy()
        center = np.argwhere(mask > 0).mean(axis=0).astype(int)
        assert pixels[tuple(center)].argmax() == 0, "red under the label, whatever the augmentation"
        count += 1
    assert count == len(train_images(root))
    for batch in data.val_dataloader():
        for pixels, number in batch:
            image = next(image for image in data.folder.val.images if image.id == number)
            mask = image.objects[0].mask(image.height, image.width)
            assert_labeled(pixels.permute(1, 2, 0).numpy(), mask)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
def test_every_reader_gives_the_same_upright_image(tmp_path: Path, suffix: str) -> None:
    for orientation in ALL:
        save(draw(), tmp_path / "b" / f"{orientation}.{suffix}", orientation)
    mask = np.asarray(draw())[..., 0] == COLOR[0]
    for path in sorted((tmp_path / "b").iterdir()):
        assert_labeled(read_image(CocoImage(1, path, HEIGHT, WIDTH, ())), mask)
        (shown,) = read_images(path)
        assert_labeled(shown.rgb, mask)
        fitted = grid.read_fitted(CocoImage(1, path, HEIGHT, WIDTH, ()), (HEIGHT, WIDTH))
        assert_labeled(fitted, mask)
    if suffix != "tif":
        for pixels in read_samples(tmp_path / "b", 8):
            assert_labeled(pixels, mask)


def test_turned_copy_of_validation_image_is_a_leak(tmp_path: Path) -> None:
    """Duplicates are found among the upright images."""
    root = folder(tmp_path / "a", (1, 3, 6, 8))
    scene = np.random.default_rng(0).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    scene_image = Image.fromarray(scene).resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC)
    save(scene_image, root / "images" / "val_1_1.jpg", 1)
    for file in sorted((root / "images").glob("train_*.jpg")):
        save(scene_image, file, int(file.stem.split("_")[1]))
    code, found = doctor(root)
    assert code == 1
    assert len(found["leak"]) == 4


def test_doctor_takes_image_size_that_contours_fit(tmp_path: Path) -> None:
    """A wrong size is replaced by the upright one, or by the stored one where only that fits."""
    root = folder(tmp_path / "a", (6, 6))
    content = json.loads((root / "instances_train.json").read_text())
    for image in content["images"]:
        image.update(width=640, height=480)
    long = [0, 100, 20, 100, 20, 120, 0, 120]  # below the lower edge of the upright image
    content["annotations"][1].update(segmentation=[long], bbox=[0, 100, 20, 20], area=400)
    foreign.write(root / "instances_train.json", content)
    code, found = doctor(root, "--fix", str(tmp_path / "fixed"))
    assert code == 1
    fixed = json.loads((tmp_path / "fixed" / "instances_train.json").read_text())["images"]
    sizes = [(image["width"], image["height"]) for image in fixed]
    assert sizes == [(WIDTH, HEIGHT), (HEIGHT, WIDTH)]
    assert found["image-turned"] == [fixed[0]["file_name"]]
    assert found["image-exif"] == [fixed[1]["file_name"]]


@pytest.mark.parametrize("format", ["labelme", "via", "yolo"])
def test_converted_labels_lie_on_the_object(tmp_path: Path, format: str) -> None:
    """It holds for any orientation, on disk or inside the JSON, and doctor finds no issue."""
    root = tmp_path / "source"
    x, y, w, h = BOX
    entries: dict[str, Any] = {}
    for i in ALL:
        file = save(draw(), root / "images" / ("val" if i == 8 else "train") / f"{i}.jpg", i)
        if format == "labelme":
            shape = foreign.shape("cart", "rectangle", [x, y, x + w, y + h])
            sizes = {"imageWidth": WIDTH, "imageHeight": HEIGHT}
            foreign.labelme_file(file.with_suffix(".json"), [shape], file.name, **sizes)
        elif format == "yolo":
            row = f"0 {(x + w / 2) / WIDTH} {(y + h / 2) / HEIGHT} {w / WIDTH} {h / HEIGHT}\n"
            foreign.write(root / "labels" / file.parent.name / f"{i}.txt", row)
        region = foreign.region("rect", {"kind": "cart"}, x=x, y=y, width=w, height=h)
        name = file.relative_to(root).as_posix()
        entries[name] = {"filename": name, "size": 1, "regions": [region], "file_attributes": {}}
    if format == "via":
        foreign.write(root / "via.json", entries)
    yaml = "path: .\ntrain: images/train\nval: images/val\nnames: [cart]\n"
    foreign.write(root / "data.yaml", yaml)
    splits = converted(format, root)
    for i in ALL:
        ((name, mask),) = masks_of(splits, str(i))
        assert name == "cart"
        assert_labeled(read_image(image_of(splits, str(i))), mask)


@settings(max_examples=60, deadline=None)
@given(SIZES, st.sampled_from(ALL), st.sampled_from(["png", "tif"]))
def test_pixels_are_as_pillow_shows_them(size: tuple[int, int], turned: int, suffix: str) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (*size, 3), dtype=np.uint8)
    with tempfile.TemporaryDirectory() as place:
        path = save(Image.fromarray(pixels), Path(place) / f"a.{suffix}", turned)
        found = read_rgb(path)
        assert found is not None
        assert np.array_equal(found, pixels)
        assert found.flags["C_CONTIGUOUS"]
        with Image.open(path) as image:
            assert np.array_equal(np.asarray(ImageOps.exif_transpose(image)), found)


@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, of damaged EXIF
@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=60), HEADS)
def test_damaged_exif_is_ignored(tail: bytes, head: bytes) -> None:
    data = io.BytesIO()
    draw().save(data, format="JPEG", exif=head + tail)
    with Image.open(data) as image:
        assert orientation_of(image) in ALL
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "a.jpg"
        path.write_bytes(data.getvalue())
        assert read_rgb(path) is not None
