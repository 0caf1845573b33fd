"""`cohdc synth compose`: people stand where geometry says, move with the world, and are hidden."""

import subprocess
import sys
from pathlib import Path

import coco_toys
import cv2
import numpy as np
import pytest
import yaml

from cohdc_train.cli import main
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.tum import TimestampedImage
from cohdc_train.synth.cut_outs import (
    RELIEF_M,
    CutOut,
    WalkPath,
    compose_frame,
    pixel_rays,
    render,
)

CAMERA = Camera(200.0, 200.0, 79.5, 59.5, 160, 120, 5000.0)
# Looks along the world's y axis from 1.5 m above the floor.
LEVEL = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


def standing(distance: float, amplitude: float = 0.0) -> tuple[CutOut, WalkPath]:
    """Make a red person of 0.6 x 1.2 m whose head is at 1.75 m, and its path across the view."""
    rgb = np.full((400, 200, 3), (250, 0, 0), np.uint8)
    person = CutOut.from_photo(rgb, np.ones((400, 200), bool))
    x, y = np.eye(3)[:2]
    return person, WalkPath(distance * y, x, -y, amplitude, 4.0, 0.0)


def test_person_covers_the_pixels_that_geometry_says() -> None:
    person, path = standing(4.0)
    layers, depth = render(person, path, 0.0, LEVEL, pixel_rays(CAMERA, 1))
    rows, columns = np.nonzero(np.isfinite(depth) & (layers[..., 3] > 0.5))
    assert columns.min() == pytest.approx(79.5 - 0.3 / 4 * 200, abs=1.5)
    assert columns.max() == pytest.approx(79.5 + 0.3 / 4 * 200, abs=1.5)
    assert rows.min() == pytest.approx(59.5 - 0.25 / 4 * 200, abs=1.5)
    assert rows.max() == pytest.approx(59.5 + 0.95 / 4 * 200, abs=1.5)
    assert depth[78, 79] == pytest.approx(4.0 - RELIEF_M, abs=0.02)
    assert depth[78, columns.min() + 1] > depth[78, 79] + 0.05, "a body is round"


def test_person_walks_in_the_world_and_not_with_the_camera() -> None:
    person, path = standing(2.0, amplitude=0.5)
    moved = LEVEL.copy()
    moved[0, 3] = 0.5
    rays = pixel_rays(CAMERA, 1)

    def mean_column(time: float, pose: np.ndarray) -> float:
        depth = render(person, path, time, pose, rays)[1]
        return float(np.nonzero(np.isfinite(depth))[1].mean())

    assert mean_column(0.0, LEVEL) == pytest.approx(79.5, abs=1)
    assert mean_column(1.0, LEVEL) == pytest.approx(79.5 + 0.5 / 2 * 200, abs=1)
    assert mean_column(1.0, moved) == pytest.approx(79.5, abs=1)


def test_nearer_surface_hides_a_person_and_other_pixels_stay(tmp_path: Path) -> None:
    depth = np.full((120, 160), 15000, np.uint16)  # a wall 3 m away
    depth[60:] = 5000  # and a table 1 m away
    depth[:, :20] = 0
    cv2.imwrite(str(tmp_path / "d.png"), depth)
    cv2.imwrite(str(tmp_path / "c.png"), np.full((120, 160, 3), 120, np.uint8))
    color, depth_image = tmp_path / "c.png", tmp_path / "d.png"
    pair = TimestampedImage(0.0, "0", color), TimestampedImage(0.0, "0", depth_image)
    layers = [render(*standing(2.0), 0.0, LEVEL, pixel_rays(CAMERA, 1))]
    rgb, units, mask = compose_frame(pair, CAMERA, layers, np.random.default_rng(0))
    assert mask[:58].any()
    assert not mask[60:].any()
    assert rgb[50, 79, 0] > rgb[50, 79, 1] + 60
    assert units[50, 79] == pytest.approx(5000 * (2 - RELIEF_M), rel=0.05)
    away = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    assert np.array_equal(units[away], depth[away])
    assert (rgb[away] == 120).all()


def write_recording(folder: Path) -> Path:
    """Write a TUM sequence of three frames in front of a wall, seen from 1.5 m above the floor."""
    lists = {"rgb": "", "depth": ""}
    images = {
        "rgb": np.full((120, 160, 3), 120, np.uint8),
        "depth": np.full((120, 160), 15000, np.uint16),
    }
    poses = ""
    for stamp in ("1.0", "1.1", "1.2"):
        for name, image in images.items():
            (folder / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / name / f"{stamp}.png"), image)
            lists[name] += f"{stamp} {name}/{stamp}.png\n"
        poses += f"{stamp} 0 0 1.5 -0.70710678 0 0 0.70710678\n"
    for name, text in lists.items():
        (folder / f"{name}.txt").write_text(text)
    (folder / "groundtruth.txt").write_text(poses)
    camera = {"fx": 200, "fy": 200, "cx": 79.5, "cy": 59.5, "width": 160, "height": 120}
    (folder / "camera.yaml").write_text(yaml.safe_dump({**camera, "depth_scale": 5000}))
    return folder


def people_folder(folder: Path) -> Path:
    """Write a COCO folder whose training image holds one person of 150 x 280 px."""
    x, y, width, height = 40, 20, 150, 280
    polygon = [x, y, x + width, y, x + width, y + height, x, y + height]
    person = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [x, y, width, height]}
    person |= {"area": width * height, "iscrowd": 0, "segmentation": [polygon]}
    content = {
        "images": [{"id": 1, "file_name": "a.png", "height": 320, "width": 240}],
        "annotations": [person],
        "categories": [{"id": 1, "name": "person"}],
    }
    coco_toys.write(folder / "instances_train.json", content)
    (folder / "images").mkdir()
    cv2.imwrite(str(folder / "images" / "a.png"), np.full((320, 240, 3), 90, np.uint8))
    return folder


def test_sequence_with_people_is_written_and_repeats(tmp_path: Path) -> None:
    recording, people = write_recording(tmp_path / "still"), people_folder(tmp_path / "people")
    for name in ("a", "b"):
        words = [str(recording), str(people), "--out", str(tmp_path / name), "--count", "1"]
        assert main(["synth", "compose", *words, "--share", "[0.05, 0.9]"]) == 0
    out = tmp_path / "a"
    assert (out / "groundtruth.txt").read_bytes() == (recording / "groundtruth.txt").read_bytes()
    assert (out / "rgb.txt").read_text() == (recording / "rgb.txt").read_text()
    masks = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in out.glob("masks/*.png")]
    assert len(masks) == 3
    assert 0.05 <= np.mean([mask > 0 for mask in masks]) <= 0.9
    files = [file for file in sorted(out.rglob("*")) if file.is_file()]
    for file in files:
        assert file.read_bytes() == (tmp_path / "b" / file.relative_to(out)).read_bytes()


def test_wrong_options_and_folders_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, people = write_recording(tmp_path / "still"), people_folder(tmp_path / "people")
    words = ["synth", "compose", str(recording), str(people), "--out", str(tmp_path / "out")]
    for option, message in (
        (["--count", "0"], "count is 0; at least 1 person is needed"),
        (["--frames", "0"], "frames is 0; at least 1 is needed"),
        (["--share", "[0.5, 0.2]"], "share is 0.5 to 0.2; both lie in 0..1, in this order"),
        (["--seed", "-1"], "seed is -1; it cannot be below 0"),
        (["--count", "9"], "1 people of 120 px or more, 9 wanted"),
    ):
        assert main([*words, *option]) == 1
        error = capsys.readouterr().err
        assert error.startswith("cohdc synth: ")
        assert error.endswith(f"{message}\n")
        assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_help_loads_no_torch() -> None:
    code = (
        "import sys; from cohdc_train.synth.compose import compose; print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
