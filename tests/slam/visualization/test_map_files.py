"""Files of the map: static surfaces in their place, without a person who walked through."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, passer_by, render, room, write_sequence
from ply_reader import read_ply

from cohdc_train.cli import main
from cohdc_train.slam.config import DenseCloudConfig
from cohdc_train.slam.io.ply import write_ply
from cohdc_train.slam.run import slam
from cohdc_train.slam.visualization.depth_fusion import (
    KeyframeImage,
    filter_depth,
    fuse_depth_images,
    remove_dynamic_depth,
)
from cohdc_train.slam.visualization.point_cloud import PointCloud
from cohdc_train.slam.visualization.top_view import render_top_view
from cohdc_train.slam.visualization.voxel_grid import VoxelGrid

Points = NDArray[np.float64]
MAX_DEPTH_M = 5.0


def distance_to_room(points: Points) -> Points:
    """Return the distance [n] m to the nearest plane of the room."""
    distances = []
    for item in room():
        normal = np.cross(item.across, item.down)
        distances.append(np.abs((points - item.origin) @ normal) / np.linalg.norm(normal))
    return np.min(distances, axis=0)


def is_on_the_board(points: Points) -> NDArray[np.bool_]:
    """Select points where the board of the passer-by went, 1.6 m from the first camera."""
    return (np.abs(points[:, 2] - 1.6) < 0.12) & (np.abs(points[:, 1]) < 0.7)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run `cohdc slam --dense_cloud` in a room that a board is carried through."""
    folder = tmp_path_factory.mktemp("map")
    sequence = write_sequence(folder / "walk", 36, with_passer_by=True)
    words = [
        "slam",
        str(sequence),
        "--masks",
        str(sequence / "masks"),
        "--out",
        str(folder / "run"),
    ]
    assert main([*words, "--settings.features.max_keypoints", "500", "--dense_cloud"]) == 0
    assert {path.name for path in folder.iterdir()} == {"walk", "run"}
    return folder / "run"


@pytest.mark.parametrize(("name", "least"), [("map.ply", 300), ("cloud.ply", 20_000)])
def test_points_lie_on_static_surfaces(run: Path, name: str, least: int) -> None:
    points, colors = read_ply(run / name)
    assert len(points) > least
    assert np.median(distance_to_room(points)) < 0.003
    assert np.mean(distance_to_room(points) > 0.03) < 0.01
    assert not is_on_the_board(points).any()
    assert colors.std() > 20, "the room is colorful"


def test_points_have_the_colors_of_the_room(run: Path) -> None:
    points, colors = read_ply(run / "cloud.ply")
    rgb, depth, _ = render(room(), np.eye(4))
    columns, rows = np.rint(CAMERA.project(points)).astype(int).T
    inside = (columns >= 0) & (rows >= 0) & (columns < CAMERA.width) & (rows < CAMERA.height)
    columns, rows, z = columns[inside], rows[inside], points[inside, 2]
    front = np.abs(depth[rows, columns] - z) < 0.02
    difference = np.abs(rgb[rows, columns].astype(int) - colors[inside])[front].mean(axis=1)
    assert np.median(difference) < 12


def test_top_view_shows_points_and_trajectory(run: Path) -> None:
    image = cv2.imread(str(run / "map.png"))
    assert max(image.shape) <= 902
    assert (image == 255).all(axis=2).mean() < 0.99
    assert (image == (40, 40, 230)).all(axis=2).any(), "the trajectory in red"


def test_run_without_a_tracked_frame_leaves_empty_valid_clouds(tmp_path: Path) -> None:
    sequence = write_sequence(tmp_path / "walk", 2)
    for file in (sequence / "rgb").iterdir():
        cv2.imwrite(str(file), np.zeros((240, 320, 3), np.uint8))
    slam(sequence, out=tmp_path / "run", dense_cloud=True)
    for name in ("map.ply", "cloud.ply"):
        assert len(read_ply(tmp_path / "run" / name)[0]) == 0
    assert not (tmp_path / "run" / "map.png").exists()


def render_frames(steps: list[int], boards: list[int | None]) -> list[KeyframeImage]:
    """Render frames without masks; a board of the given step stands in some."""
    path, frames = camera_path(60), []
    for step, board in zip(steps, boards, strict=True):
        things = room() if board is None else [*room(), passer_by(board)]
        rgb, depth, _ = render(things, path[step])
        frames.append(KeyframeImage(float(step), rgb, depth))
    return frames


def fuse(frames: list[KeyframeImage], steps: list[int]) -> PointCloud:
    """Fuse frames at the true poses of some steps."""
    poses = {float(step): np.linalg.inv(camera_path(60)[step]) for step in steps}
    return fuse_depth_images(frames, poses, CAMERA, MAX_DEPTH_M, DenseCloudConfig(voxel_m=0.02))


def test_object_seen_once_or_seen_through_is_removed() -> None:
    steps = [0, 5, 10, 15, 20]
    stays = fuse(render_frames(steps, [20] * 5), steps)
    assert is_on_the_board(stays.points).sum() > 1000, (
        "an object that never moves and has no mask is part of the room"
    )
    once = fuse(render_frames(steps[:2], [None, 20]), steps)
    leaves = fuse(render_frames(steps, [20, 20, None, None, None]), steps)
    for cloud in (once, leaves):
        assert not is_on_the_board(cloud.points).any()
        assert np.median(distance_to_room(cloud.points)) < 0.002
        assert len(cloud) > 5000


def test_keyframe_without_a_pose_is_skipped() -> None:
    steps = [0, 5, 10]
    frames = render_frames(steps, [None] * 3)
    without = fuse(frames, steps[:2])
    np.testing.assert_array_equal(without.points, fuse(frames[:2], steps).points)


def test_depth_is_removed_beside_edges_and_masks_and_far_away() -> None:
    depth = np.full((40, 100), 2.0, np.float32)
    depth[:, 60:] = 3.0
    depth[:, 90:] = 6.0
    mask = np.zeros(depth.shape, np.bool_)
    mask[:, :10] = True
    kept = filter_depth(remove_dynamic_depth(depth, mask), CAMERA, MAX_DEPTH_M)[20] > 0
    assert np.flatnonzero(kept).tolist() == [*range(10 + 1, 60 - 2), *range(60 + 2, 90 - 2)]


clouds = arrays(
    np.float64, st.tuples(st.integers(1, 60), st.just(3)), elements=st.floats(-50, 50, width=32)
)


@given(clouds, st.integers(0, 1_000_000))
@settings(max_examples=60)
def test_voxels_hold_means_in_any_order(points: Points, seed: int) -> None:
    rng = np.random.default_rng(seed)
    grids = [VoxelGrid(0.5, 4_000_000) for _ in range(2)]
    colors = rng.integers(0, 256, points.shape).astype(np.uint8)
    for grid, order in zip(
        grids, (np.arange(len(points)), rng.permutation(len(points))), strict=True
    ):
        for part in np.array_split(order, 3):
            grid.add(points[part], colors[part], 0)
    first, second = (grid.cells(1)[0] for grid in grids)
    np.testing.assert_allclose(first, second, atol=1e-9)
    assert len(first) == len(np.unique(np.floor(points / 0.5), axis=0))
    assert np.linalg.norm(points[:, None] - first[None], axis=2).min(axis=1).max() <= 0.5 * np.sqrt(
        3
    )


@given(clouds)
@settings(max_examples=60)
def test_memory_is_bounded_by_larger_voxels(points: Points) -> None:
    grid = VoxelGrid(0.001, max_voxels=8)
    for image in range(2):
        grid.add(points, np.zeros(points.shape, np.uint8), image)
    means, _ = grid.cells(2)
    assert 1 <= len(means) <= 8
    assert len(means) == len(np.unique(np.floor(points / grid.edge), axis=0)), (
        "as if the voxels had this size from the start"
    )


def test_top_view_shows_forward_as_up_and_right_as_right() -> None:
    places = np.array([[0, 1, 4.0], [2, 1, 2.0], [-2, 1, 2.0], [0, -3, 3.0]])
    colors = np.array([[0, 0, 255], [0, 255, 0], [1, 2, 3], [255, 0, 255]], dtype=np.uint8)
    image = render_top_view(PointCloud(places, colors), [np.eye(4)])

    def place(color: list[int]) -> NDArray[np.float64]:
        return np.argwhere((image == color).all(axis=2)).mean(axis=0)

    ahead, right, left = place([0, 0, 255]), place([0, 255, 0]), place([1, 2, 3])
    assert ahead[0] < right[0] == left[0]
    assert left[1] < ahead[1] < right[1]
    assert not (image == colors[3]).all(axis=2).any(), "the ceiling is not drawn"


def test_ply_file_holds_points_and_colors(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", np.array([[1.0, -2.5, 3.0]]), np.array([[7, 8, 9]], np.uint8))
    points, colors = read_ply(tmp_path / "a.ply")
    assert points.tolist() == [[1.0, -2.5, 3.0]]
    assert colors.tolist() == [[7, 8, 9]]
    assert (
        (tmp_path / "a.ply")
        .read_bytes()
        .endswith(np.array([1, -2.5, 3], "<f4").tobytes() + bytes([7, 8, 9]))
    )


def test_mask_margin_of_the_dense_cloud_is_an_option() -> None:
    depth, mask = np.full((40, 100), 2.0, np.float32), np.zeros((40, 100), np.bool_)
    mask[:, :10] = True
    kept = remove_dynamic_depth(depth, mask, DenseCloudConfig(mask_margin_ratio=0.05))[20] > 0
    assert np.flatnonzero(kept).tolist() == list(range(15, 100))
