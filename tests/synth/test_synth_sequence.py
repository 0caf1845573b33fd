"""RGB-D sequences: TUM's layout, and ground truth that agrees with the pixels."""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from cohdc_train.errors import DataError
from cohdc_train.synth import sequence
from cohdc_train.synth.renderer import render
from cohdc_train.synth.scenario import draw_scene

pytest.importorskip("embreex")

SIZE = (120, 160)
FRAMES = 16


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("synth") / "walking"
    sequence(out, frames=FRAMES, size=SIZE, seed=4)
    return out


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def test_sequence_has_files_of_tum_layout(folder: Path) -> None:
    names = {p.name for p in folder.iterdir()}
    assert names == {
        *(
            "rgb",
            "depth",
            "masks",
            "movers",
            "rgb.txt",
            "depth.txt",
            "groundtruth.txt",
            "camera.yaml",
            "info.json",
        ),
    }
    for kind, dtype in (
        ("rgb", np.uint8),
        ("depth", np.uint16),
        ("masks", np.uint8),
        ("movers", np.uint8),
    ):
        files = sorted((folder / kind).iterdir())
        assert len(files) == FRAMES
        image = cv2.imread(str(files[0]), cv2.IMREAD_UNCHANGED)
        assert image.dtype == dtype
        assert image.shape == ((*SIZE, 3) if kind == "rgb" else SIZE)
    for kind, title in (("rgb", "# color images"), ("depth", "# depth maps")):
        text = (folder / f"{kind}.txt").read_text().splitlines()
        assert text[0] == title
        assert text[1].startswith("# file: '")
        assert text[2] == "# timestamp filename"
        listed = rows(folder / f"{kind}.txt")
        assert len(listed) == FRAMES
        assert all(
            name == f"{kind}/{timestamp}.png" and (folder / name).is_file()
            for timestamp, name in listed
        )
        timestamps = np.array([float(timestamp) for timestamp, _ in listed])
        np.testing.assert_allclose(np.diff(timestamps), 1 / 30, atol=2e-6)
    assert listed[0][0] == "1305031102.175304"
    truth = (folder / "groundtruth.txt").read_text().splitlines()
    assert truth[0] == "# ground truth trajectory"
    assert truth[2] == "# timestamp tx ty tz qx qy qz qw"
    values = np.array(rows(folder / "groundtruth.txt"), dtype=float)
    assert values.shape == (3 * (FRAMES - 1) + 1, 8)
    np.testing.assert_allclose(np.linalg.norm(values[:, 4:], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(
        values[::3, 0], [float(timestamp) for timestamp, _ in listed], atol=2e-6
    )


def test_camera_file_has_intrinsics(folder: Path) -> None:
    camera = yaml.safe_load((folder / "camera.yaml").read_text())
    assert set(camera) == {"fx", "fy", "cx", "cy", "width", "height", "depth_scale"}
    assert camera["fx"] == pytest.approx(535.4 / 4)
    assert (camera["height"], camera["width"]) == SIZE
    assert camera["depth_scale"] == 5000


def test_masks_are_binary_and_info_has_their_share(folder: Path) -> None:
    info = json.loads((folder / "info.json").read_text())
    shares = []
    for path in sorted((folder / "masks").iterdir()):
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert set(np.unique(mask)) <= {0, 255}
        shares.append((mask == 255).mean())
    np.testing.assert_allclose(info["share_per_frame"], shares, atol=1e-5)
    assert info["share"]["mean"] == pytest.approx(np.mean(shares))
    assert max(shares) > 0.05


def test_masks_are_the_rendered_people(folder: Path) -> None:
    scene = draw_scene(4, FRAMES, SIZE, "xyz", 3)
    view = scene.render_frame(7, scene.atlas())
    masks = sorted((folder / "masks").iterdir())
    np.testing.assert_array_equal(cv2.imread(str(masks[7]), 0) == 255, view.instance > 0)


def test_groundtruth_maps_depth_between_frames(folder: Path) -> None:
    """Static pixels of the first frame, moved by groundtruth.txt, meet the depth of the last."""
    camera = yaml.safe_load((folder / "camera.yaml").read_text())
    K = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]])
    truth = np.array(rows(folder / "groundtruth.txt"), dtype=float)
    timestamps = [timestamp for timestamp, _ in rows(folder / "depth.txt")]

    def frame(k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(truth[3 * k, 4:]).as_matrix()
        pose[:3, 3] = truth[3 * k, 1:4]
        depth = (
            cv2.imread(str(folder / "depth" / f"{timestamps[k]}.png"), cv2.IMREAD_UNCHANGED)
            / camera["depth_scale"]
        )
        return pose, depth, cv2.imread(str(folder / "masks" / f"{timestamps[k]}.png"), 0) == 0

    (first_pose, first, first_static), (last_pose, last, last_static) = frame(0), frame(FRAMES - 1)
    v, u = np.nonzero(first_static & (first > 0))
    points = np.linalg.inv(K) @ np.stack([u, v, np.ones_like(u)]) * first[v, u]
    moved = np.linalg.inv(last_pose) @ first_pose @ np.vstack([points, np.ones(len(u))])
    pixel = (K @ moved[:3])[:2] / moved[2]
    x, y = np.rint(pixel).astype(int)
    inside = (x >= 0) & (y >= 0) & (x < SIZE[1]) & (y < SIZE[0])
    x, y, z = x[inside], y[inside], moved[2, inside]
    seen = last_static[y, x] & (last[y, x] > 0)
    sigma = np.hypot(0.0012 + 0.0019 * (z - 0.4) ** 2, 0.0012 + 0.0019 * (last[y, x] - 0.4) ** 2)
    error = (np.abs(last[y, x] - z) / sigma)[seen]
    assert seen.sum() > 3000
    assert np.linalg.norm(first_pose[:3, 3] - last_pose[:3, 3]) > 0.02
    assert np.median(error) == pytest.approx(0.674, abs=0.15), (
        "a normal distribution of the sensor's sigma"
    )
    assert (error < 3.5).mean() > 0.9


def test_wall_depth_follows_geometry_of_room() -> None:
    scene = draw_scene(4, 2, SIZE, "static", 0)
    pose = scene.poses[0]
    view = render(scene.room.mesh, scene.atlas(), scene.room.lighting, scene.camera, pose)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    rays = np.stack(
        [
            (u - scene.camera.cx) / scene.camera.fx,
            (v - scene.camera.cy) / scene.camera.fy,
            np.ones_like(u),
        ],
        -1,
    )
    world = (rays @ pose[:3, :3].T) * view.depth[..., None] + pose[:3, 3]
    width, length, height = scene.room.size
    assert (view.depth > 0).all(), "a room has no holes"
    assert world[..., 1].max() == pytest.approx(length, abs=1e-3)
    assert world[..., 2].min() == pytest.approx(0, abs=1e-3)
    on_wall = np.abs(world[..., 1] - length) < 1e-3
    assert on_wall.mean() > 0.1
    assert np.abs(world[..., 0]).max() < width / 2 + 1e-3
    assert world[..., 2].max() < height + 1e-3
    assert (view.facing > 0).mean() > 0.995, "every surface of the room faces the room"


@pytest.mark.parametrize("seed", [0, 1])
def test_people_cover_a_fifth_to_two_fifths(seed: int) -> None:
    scene = draw_scene(seed, 240, SIZE, "xyz", 3)
    coarse, atlas = replace(scene, camera=scene.camera.resized(0.5)), scene.atlas()
    shares = np.array(
        [(coarse.render_frame(k, atlas).instance > 0).mean() for k in range(0, 240, 12)]
    )
    assert 0.2 < shares.mean() < 0.4
    assert shares.max() < 0.68


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    def digests(name: str, seed: int) -> dict[str, str]:
        sequence(tmp_path / name, frames=3, size=(48, 64), seed=seed, people=1)
        files = sorted(p for p in (tmp_path / name).rglob("*") if p.is_file())
        return {
            str(p.relative_to(tmp_path / name)): hashlib.sha256(p.read_bytes()).hexdigest()
            for p in files
        }

    first, again, other = digests("a", 0), digests("b", 0), digests("c", 1)
    assert first == again
    assert all(first[name] != other[name] for name in first if name.startswith(("rgb/", "depth/")))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"frames": 1}, "frames: 1 is too few"),
        ({"size": (480, 12)}, "size: 480 x 12 px"),
        ({"seed": -1}, "seed: -1"),
        ({"motion": "spiral"}, "motion: 'spiral'"),
        ({"people": 13}, "people: 13"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line(
    tmp_path: Path, arguments: dict[str, object], message: str
) -> None:
    with pytest.raises(DataError, match=message) as caught:
        sequence(tmp_path / "s", **arguments)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_import_of_synth_is_cheap() -> None:
    code = (
        "import sys, cohdc_train.synth;"
        "print([name for name in ('embreex', 'torch', 'scipy') if name in sys.modules])"
    )
    command = [sys.executable, "-c", code]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert printed == "[]\n"
