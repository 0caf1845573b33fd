"""Lists and images of TUM's format: pairing, and errors that name file and line."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from plane_world import CAMERA

from cohdc_train.errors import DataError
from cohdc_train.slam.io.sources import RecordedSequence
from cohdc_train.slam.io.tum import Pair, read_depth, read_mask, read_pairs, read_rgb


def write_lists(folder: Path, rgb: list[float], depth: list[float]) -> Path:
    """Write a sequence of empty image files with these timestamps."""
    for name, timestamps in (("rgb", rgb), ("depth", depth)):
        (folder / name).mkdir()
        for timestamp in timestamps:
            (folder / name / f"{timestamp:.3f}.png").touch()
        rows = "".join(f"{t:.3f} {name}/{t:.3f}.png\n" for t in timestamps)
        (folder / f"{name}.txt").write_text("# timestamp file\n" + rows)
    return folder


def pairs_of(folder: Path) -> tuple[list[Pair], int]:
    """Pair the two lists of a folder."""
    return read_pairs(folder / "rgb.txt", folder / "depth.txt", 0.02)


def test_images_are_paired_one_to_one_with_the_nearest(tmp_path: Path) -> None:
    folder = write_lists(tmp_path, [1.000, 1.030, 1.060, 2.0], [1.005, 1.028, 1.034])
    pairs, num_unpaired = pairs_of(folder)
    names = [(color.timestamp_text, depth.path.stem) for color, depth in pairs]
    assert names == [("1.000", "1.005"), ("1.030", "1.028")]
    assert num_unpaired == 2
    assert RecordedSequence(folder, CAMERA).groundtruth is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1.0 rgb/1.000.png extra\n", "rgb.txt:1: expected 'timestamp filename', found 3 words"),
        ("# c\nsoon rgb/1.000.png\n", "rgb.txt:2: timestamp 'soon' is not a number"),
        ("nan rgb/1.000.png\n", "rgb.txt:1: timestamp 'nan' is not finite"),
        (
            "1.0 rgb/1.000.png\n0.5 rgb/1.000.png\n",
            "rgb.txt:2: timestamp 0.5 does not come after 1.0",
        ),
        ("1.0 rgb/gone.png\n", "rgb.txt:1: rgb/gone.png does not exist"),
        ("# nothing\n", "rgb.txt: lists no image"),
        ("9.0 rgb/1.000.png\n", "no image of rgb.txt lies within 0.02 s"),
    ],
)
def test_broken_list_is_one_line_with_its_place(tmp_path: Path, text: str, message: str) -> None:
    folder = write_lists(tmp_path, [1.0], [1.0])
    (folder / "rgb.txt").write_text(text)
    with pytest.raises(DataError) as caught:
        pairs_of(folder)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_list_is_named(tmp_path: Path) -> None:
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


def test_images_of_another_size_or_type_are_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((120, 160), dtype=np.uint16))
    cv2.imwrite(str(tmp_path / "eight.png"), np.zeros((240, 320), dtype=np.uint8))
    with pytest.raises(DataError, match=r"small\.png: image is 160x120, but the camera is 320x240"):
        read_depth(tmp_path / "small.png", CAMERA)
    message = r"eight\.png: depth must be one channel of 16 bits, not uint8"
    with pytest.raises(DataError, match=message):
        read_depth(tmp_path / "eight.png", CAMERA)


def test_files_that_are_no_images_are_named(tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("not an image")
    (tmp_path / "empty.png").touch()
    for name in ("text.png", "empty.png"):
        with pytest.raises(DataError, match=f"{name}: not an image"):
            read_rgb(tmp_path / name, CAMERA)
    with pytest.raises(DataError, match=r"none\.png: cannot be read"):
        read_mask(tmp_path / "none.png", CAMERA)
