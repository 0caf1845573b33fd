"""Depth of a rectified stereo pair, against OpenCV and the truth."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from plane_world import CAMERA, CAMERA_YAML, camera_path, passer_by, render, room, write_sequence

from cohdc_train.cli import main
from cohdc_train.errors import DataError
from cohdc_train.slam.config import DepthConfig, StereoConfig
from cohdc_train.slam.geometry.calibration import load_camera
from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.sources import RecordedSequence
from cohdc_train.slam.io.stereo import StereoMatcher, reproject, reprojection_matrix, stereo_format

BASELINE = 0.12
PAIR = Camera(260.0, 260.0, 159.5, 119.5, 320, 240, 1.0, baseline=BASELINE)
STEREO_YAML = CAMERA_YAML.replace("depth_scale: 5000", f"baseline: {BASELINE}")


def right_of(T_wc: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pose of the right camera [4, 4]."""
    offset = np.eye(4)
    offset[0, 3] = BASELINE
    return T_wc @ offset


def write_stereo(folder: Path, frames: int, with_passer_by: bool = False) -> Path:
    """Write a stereo sequence; the right images are 1 ms later than the left ones."""
    write_sequence(folder, frames, with_passer_by)
    (folder / "right").mkdir()
    lines = []
    for index, pose in enumerate(camera_path(frames)):
        things = [*room(), passer_by(index)] if with_passer_by else room()
        name = f"right/{index:04d}.png"
        cv2.imwrite(
            str(folder / name), cv2.cvtColor(render(things, right_of(pose))[0], cv2.COLOR_RGB2BGR)
        )
        lines.append(f"{100.001 + index / 30:.6f} {name}")
    (folder / "right.txt").write_text("\n".join(lines) + "\n")
    (folder / "rgb.txt").rename(folder / "left.txt")
    (folder / "depth.txt").unlink()
    (folder / "camera.yaml").write_text(STEREO_YAML)
    return folder


@settings(max_examples=25)
@given(
    st.floats(100, 900),
    st.floats(0, 640),
    st.floats(0, 480),
    st.floats(0.02, 1.0),
    st.integers(0, 999),
)
def test_reprojection_equals_that_of_opencv(
    f: float, cx: float, cy: float, baseline: float, seed: int
) -> None:
    camera = Camera(f, f, cx, cy, 40, 30, 1.0, baseline=baseline)
    K, none, T = camera.matrix(), np.zeros(5), np.array([[-baseline], [0], [0]])
    theirs = cv2.stereoRectify(K, none, K, none, (40, 30), np.eye(3), T, alpha=0)[4]
    Q = reprojection_matrix(camera)
    np.testing.assert_allclose(
        theirs[3], Q[3], rtol=1e-9, atol=1e-9, err_msg="the sign and the principal columns"
    )
    disparity = np.random.default_rng(seed).uniform(0.5, 100, (30, 40)).astype(np.float32)
    expected = cv2.reprojectImageTo3D(disparity, Q.astype(np.float64), ddepth=cv2.CV_32F)
    points = reproject(disparity, Q)
    np.testing.assert_allclose(points, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(points[..., 2], f * baseline / disparity, rtol=1e-6)  # eq. 3
    np.testing.assert_allclose(camera.project(points[3, 7]), [7, 3], atol=1e-6)


def test_depth_of_a_pair_agrees_with_the_truth() -> None:
    T_wc = camera_path(60)[17]
    left, depth, _ = render(room(), T_wc)
    right, _, _ = render(room(), right_of(T_wc))
    found = StereoMatcher(PAIR)(left, right)
    matched = found > 0
    assert found.shape == depth.shape
    assert found.dtype == np.float32
    assert matched[:, 64:].mean() > 0.8, (
        "most pixels are matched, except at the border that only the left camera sees"
    )
    disparity_error = PAIR.fx * BASELINE * np.abs(1 / found[matched] - 1 / depth[matched])
    assert np.median(disparity_error) < 0.2
    assert np.mean(disparity_error > 1) < 0.05


@pytest.mark.slow
def test_stereo_sequence_is_tracked(tmp_path: Path) -> None:
    sequence = write_stereo(tmp_path / "pair", 30, with_passer_by=True)
    words = [
        "slam",
        str(sequence),
        "--masks",
        str(sequence / "masks"),
        "--out",
        str(tmp_path / "run"),
    ]
    assert main([*words, "--settings.features.max_keypoints", "500", "--dense_cloud"]) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["frames"] == 30
    assert metrics["coverage"] == 1.0
    assert metrics["ate_m"]["rmse"] < 0.015
    assert metrics["ms"]["depth"]["p50"] > 0
    assert (tmp_path / "run" / "cloud.ply").stat().st_size > 50_000


def test_camera_with_a_baseline_needs_no_depth_scale(tmp_path: Path) -> None:
    (tmp_path / "camera.yaml").write_text(STEREO_YAML)
    assert load_camera(tmp_path / "camera.yaml") == PAIR
    assert DepthConfig().limit_m(CAMERA.baseline) == 5.0
    assert DepthConfig().limit_m(PAIR.baseline) == pytest.approx(4.8)


@pytest.mark.parametrize(
    ("yaml", "said"),
    [
        (CAMERA_YAML, "needs baseline"),
        (STEREO_YAML + "k1: 0.1\n", "no distortion"),
        (STEREO_YAML.replace("fy: 260", "fy: 200"), "fx = fy"),
        (
            STEREO_YAML.replace("0.12", "-0.12"),
            "camera.yaml:7: baseline cannot be below 0, and is -0.12",
        ),
        (STEREO_YAML.replace("baseline: 0.12", ""), "missing depth_scale"),
    ],
    ids=["no baseline", "distortion", "two focal lengths", "negative", "neither"],
)
def test_camera_of_an_unrectified_pair_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], yaml: str, said: str
) -> None:
    sequence = write_stereo(tmp_path / "pair", 1)
    (sequence / "camera.yaml").write_text(yaml)
    assert main(["slam", str(sequence), "--out", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["pair"]


def test_images_too_far_apart_in_time_are_no_pair(tmp_path: Path) -> None:
    sequence = write_stereo(tmp_path / "pair", 2)
    (sequence / "right.txt").write_text("100.010 right/0000.png\n")
    with pytest.raises(
        DataError, match=r"pair: no image of left\.txt lies within 0\.005 s of one of right\.txt"
    ):
        RecordedSequence(sequence, PAIR, stereo_format(PAIR))


def test_options_of_stereo_depth_reach_matcher_and_lists() -> None:
    config = StereoConfig(max_time_difference_s=0.5, max_disparity_ratio=0.1, block_px=7)
    matcher = StereoMatcher(PAIR, config)._matcher
    assert (matcher.getNumDisparities(), matcher.getBlockSize()) == (32, 7)
    assert stereo_format(PAIR, config).max_difference_s == 0.5
