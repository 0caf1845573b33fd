"""Sequence folders: association and what can be wrong with their files."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from plane_world import CAMERA

from cohdc_train.errors import DataError
from cohdc_train.slam.io.tum import Entry, read_depth, read_mask, read_pairs, read_rgb


def folder(tmp_path: Path, rgb: list[float], depth: list[float]) -> Path:
    """A sequence of empty image files with these stamps."""
    for name, stamps in (("rgb", rgb), ("depth", depth)):
        (tmp_path / name).mkdir()
        for stamp in stamps:
            (tmp_path / name / f"{stamp:.3f}.png").touch()
        rows = "".join(f"{stamp:.3f} {name}/{stamp:.3f}.png\n" for stamp in stamps)
        (tmp_path / f"{name}.txt").write_text("# stamp file\n" + rows)
    return tmp_path


def pairs_of(root: Path) -> tuple[list[tuple[Entry, Entry]], int]:
    """Read the pairs of a sequence."""
    return read_pairs(root / "rgb.txt", root / "depth.txt", 0.02)


def test_nearest_association_one_to_one(tmp_path: Path) -> None:
    root = folder(tmp_path, [1.000, 1.030, 1.060, 2.0], [1.005, 1.028, 1.034])
    pairs, without_depth = pairs_of(root)
    stamps = [(color.stamp, depth.image.stem) for color, depth in pairs]
    assert stamps == [("1.000", "1.005"), ("1.030", "1.028")]
    assert without_depth == 2


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1.0 rgb/1.000.png extra\n", "rgb.txt:1: expected 'timestamp filename', found 3 words"),
        ("# c\nsoon rgb/1.000.png\n", "rgb.txt:2: time stamp 'soon' is not a number"),
        (
            "1.0 rgb/1.000.png\n0.5 rgb/1.000.png\n",
            "rgb.txt:2: time stamp 0.5 does not come after 1.0",
        ),
        ("1.0 rgb/gone.png\n", "rgb.txt:1: rgb/gone.png does not exist"),
        ("# nothing\n", "rgb.txt: lists no image"),
        ("9.0 rgb/1.000.png\n", "no image of rgb.txt lies within 0.02 s"),
    ],
)
def test_a_broken_list_is_one_line_with_its_place(tmp_path: Path, text: str, said: str) -> None:
    root = folder(tmp_path, [1.0], [1.0])
    (root / "rgb.txt").write_text(text)
    with pytest.raises(DataError) as caught:
        pairs_of(root)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_list_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"rgb\.txt: cannot be read"):
        pairs_of(tmp_path)


def test_images_are_read_in_their_units(tmp_path: Path) -> None:
    color = np.zeros((240, 320, 3), dtype=np.uint8)
    color[..., 2] = 200  # red, as OpenCV orders it
    cv2.imwrite(str(tmp_path / "c.png"), color)
    cv2.imwrite(str(tmp_path / "d.png"), np.full((240, 320), 7500, dtype=np.uint16))
    cv2.imwrite(str(tmp_path / "m.png"), np.full((240, 320), 1, dtype=np.uint8))
    assert read_rgb(tmp_path / "c.png", CAMERA)[0, 0].tolist() == [200, 0, 0]
    assert read_depth(tmp_path / "d.png", CAMERA)[5, 5] == pytest.approx(1.5)
    assert read_mask(tmp_path / "m.png", CAMERA).all()


def test_images_that_do_not_fit_are_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((120, 160), dtype=np.uint16))
    cv2.imwrite(str(tmp_path / "eight.png"), np.zeros((240, 320), dtype=np.uint8))
    (tmp_path / "text.png").write_text("not an image")
    (tmp_path / "empty.png").touch()
    with pytest.raises(DataError, match=r"small\.png: image is 160x120, the camera says 320x240"):
        read_depth(tmp_path / "small.png", CAMERA)
    with pytest.raises(
        DataError, match=r"eight\.png: depth must be one channel of 16 bit, not uint8"
    ):
        read_depth(tmp_path / "eight.png", CAMERA)
    for name in ("text.png", "empty.png"):
        with pytest.raises(DataError, match=f"{name}: not an image"):
            read_rgb(tmp_path / name, CAMERA)
    with pytest.raises(DataError, match=r"none\.png: cannot be read"):
        read_mask(tmp_path / "none.png", CAMERA)
