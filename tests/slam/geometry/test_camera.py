"""Camera files, the choice of one for a sequence, and distortion."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plane_world import CAMERA, CAMERA_YAML

from cohdc_train.errors import DataError
from cohdc_train.presets import config_path
from cohdc_train.slam.geometry.calibration import choose_camera, load_camera
from cohdc_train.slam.geometry.camera import Camera

FREIBURG1 = load_camera(config_path("slam/freiburg1.yaml"))


@pytest.mark.parametrize(
    ("name", "fx", "k1"),
    [("freiburg1", 517.3, 0.2624), ("freiburg2", 520.9, 0.2312), ("freiburg3", 535.4, 0.0)],
)
def test_shipped_presets_are_read(name: str, fx: float, k1: float) -> None:
    camera = load_camera(config_path(f"slam/{name}.yaml"))
    assert (camera.fx, camera.k1, camera.width, camera.height, camera.depth_scale) == (
        fx,
        k1,
        640,
        480,
        5000,
    )


@pytest.mark.parametrize(
    ("folder", "preset"),
    [
        ("rgbd_dataset_freiburg1_xyz", "freiburg1"),
        ("rgbd_dataset_freiburg3_walking_xyz", "freiburg3"),
        ("fr2_desk", "freiburg2"),
    ],
)
def test_camera_is_guessed_from_the_folder_name(tmp_path: Path, folder: str, preset: str) -> None:
    (tmp_path / folder).mkdir()
    camera, origin = choose_camera(tmp_path / folder, None)
    assert camera == load_camera(config_path(f"slam/{preset}.yaml"))
    assert preset in origin
    assert "guessed" in origin


def test_given_file_wins_over_the_folder_and_its_name(tmp_path: Path) -> None:
    sequence = tmp_path / "freiburg1_mine"
    sequence.mkdir()
    (sequence / "camera.yaml").write_text(CAMERA_YAML)
    given_file = tmp_path / "given.yaml"
    given_file.write_text(CAMERA_YAML.replace("fx: 260", "fx: 300"))
    assert choose_camera(sequence, None)[0] == CAMERA
    assert choose_camera(sequence, given_file)[0].fx == 300
    with pytest.raises(
        DataError, match=r"unnamed: the folder.s name does not tell the camera; .* --camera"
    ):
        choose_camera(tmp_path / "unnamed", None)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CAMERA_YAML.replace("fx: 260", "fx: wide"), ":1: fx is not a number"),
        (CAMERA_YAML.replace("fy: 260", "fy: -3"), ":2: fy must be above 0"),
        (CAMERA_YAML.replace("cx: 159.5", "cx: nan"), ":3: cx is not a finite number"),
        (CAMERA_YAML + "k9: 1\n", ":8: unknown key 'k9'"),
        (CAMERA_YAML.replace("depth_scale: 5000\n", ""), ": missing depth_scale"),
        ("fx: [1, 2\nfy: 3\n", "broken YAML"),
        ("- 1\n", ":1: a camera file holds lines"),
    ],
)
def test_broken_camera_file_is_one_line_with_its_place(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(DataError) as caught:
        load_camera(path)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def distort(camera: Camera, ideal: np.ndarray) -> np.ndarray:
    """Apply the Brown-Conrady distortion as OpenCV documents it."""
    x, y = (ideal[:, 0] - camera.cx) / camera.fx, (ideal[:, 1] - camera.cy) / camera.fy
    r2 = x * x + y * y
    radial = 1 + camera.k1 * r2 + camera.k2 * r2**2 + camera.k3 * r2**3
    xd = x * radial + 2 * camera.p1 * x * y + camera.p2 * (r2 + 2 * x * x)
    yd = y * radial + camera.p1 * (r2 + 2 * y * y) + 2 * camera.p2 * x * y
    return np.stack([xd * camera.fx + camera.cx, yd * camera.fy + camera.cy], axis=1)


@given(st.lists(st.tuples(st.floats(20, 620), st.floats(20, 460)), min_size=1, max_size=20))
def test_undistortion_inverts_the_distortion(pixels: list[tuple[float, float]]) -> None:
    ideal = np.array(pixels)
    np.testing.assert_allclose(FREIBURG1.undistort(distort(FREIBURG1, ideal)), ideal, atol=0.02)


@given(
    st.lists(
        st.tuples(st.floats(0, 639), st.floats(0, 479), st.floats(0.3, 8)), min_size=1, max_size=20
    )
)
def test_project_inverts_backproject(rows: list[tuple[float, float, float]]) -> None:
    table = np.array(rows)
    points = FREIBURG1.backproject(table[:, :2], table[:, 2])
    np.testing.assert_allclose(points[:, 2], table[:, 2])
    np.testing.assert_allclose(FREIBURG1.project(points), table[:, :2], atol=1e-9)
    K = FREIBURG1.matrix()
    np.testing.assert_allclose((points @ K.T)[:, :2] / points[:, 2:], table[:, :2], atol=1e-9)


@pytest.mark.parametrize("key", ["readout_s", "readout"])
def test_rolling_shutter_time_is_read_under_its_old_key_too(tmp_path: Path, key: str) -> None:
    (tmp_path / "camera.yaml").write_text(f"{CAMERA_YAML}{key}: 0.02\n")
    assert load_camera(tmp_path / "camera.yaml").readout_s == 0.02
