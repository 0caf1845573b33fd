"""The map's files: still things where they are, nobody who walked through, readable by others'
readers.
"""

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
from cohdc_train.slam.io.ply import write_ply
from cohdc_train.slam.run import slam
from cohdc_train.slam.visualization.depth_fusion import filter_depth, fuse, remove_dynamic_depth
from cohdc_train.slam.visualization.point_cloud import PointCloud
from cohdc_train.slam.visualization.top_view import render_top_view
from cohdc_train.slam.visualization.voxel_grid import VoxelGrid

Points = NDArray[np.float64]


def off_the_room(points: Points) -> Points:
    """[n] m between points and the nearest of the room's planes; the first camera's frame is the
    room's.
    """
    distances = []
    for item in room():
        normal = np.cross(item.across, item.down)
        distances.append(np.abs((points - item.origin) @ normal) / np.linalg.norm(normal))
    return np.min(distances, axis=0)


def on_the_board(points: Points) -> NDArray[np.bool_]:
    """Where the passer-by's board went, 1.6 m from the first camera and 30 cm before anything
    still.
    """
    return (np.abs(points[:, 2] - 1.6) < 0.12) & (np.abs(points[:, 1]) < 0.7)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `cohdc slam --cloud` leaves of a room that a board is carried through."""
    folder = tmp_path_factory.mktemp("map")
    sequence = write_sequence(folder / "walk", 36, with_passer_by=True)
    words = [
        "slam",
        "--sequence",
        str(sequence),
        "--masks",
        str(sequence / "masks"),
        "--out",
        str(folder / "run"),
    ]
    assert main([*words, "--features", "500", "--cloud"]) == 0
    assert {path.name for path in folder.iterdir()} == {"walk", "run"}
    return folder / "run"


@pytest.mark.parametrize(("name", "least"), [("map.ply", 300), ("cloud.ply", 20_000)])
def test_points_lie_on_what_stands_still(run: Path, name: str, least: int) -> None:
    points, colors = read_ply(run / name)
    assert len(points) > least
    assert np.median(off_the_room(points)) < 0.003
    assert np.mean(off_the_room(points) > 0.03) < 0.01
    assert not on_the_board(points).any()
    assert colors.std() > 20, "the room is colourful"


def test_points_have_the_colours_of_the_room(run: Path) -> None:
    points, colors = read_ply(run / "cloud.ply")
    rgb, depth, _ = render(room(), np.eye(4))
    columns, rows = np.rint(CAMERA.project(points)).astype(int).T
    inside = (columns >= 0) & (rows >= 0) & (columns < CAMERA.width) & (rows < CAMERA.height)
    columns, rows, z = columns[inside], rows[inside], points[inside, 2]
    front = np.abs(depth[rows, columns] - z) < 0.02
    difference = np.abs(rgb[rows, columns].astype(int) - colors[inside])[front].mean(axis=1)
    assert np.median(difference) < 12


def test_the_picture_from_above(run: Path) -> None:
    image = cv2.imread(str(run / "map.png"))
    assert max(image.shape) <= 902
    assert (image == 255).all(axis=2).mean() < 0.99
    assert (image == (40, 40, 230)).all(axis=2).any(), "the way in red"


def test_a_map_of_a_run_that_never_found_its_way_is_empty_and_valid(tmp_path: Path) -> None:
    sequence = write_sequence(tmp_path / "walk", 2)
    for file in (sequence / "rgb").iterdir():
        cv2.imwrite(str(file), np.zeros((240, 320, 3), np.uint8))
    slam(sequence=sequence, out=tmp_path / "run", cloud=True)
    for name in ("map.ply", "cloud.ply"):
        assert len(read_ply(tmp_path / "run" / name)[0]) == 0
    assert not (tmp_path / "run" / "map.png").exists()


def views(
    steps: list[int], boards: list[int | None]
) -> list[tuple[float, NDArray[np.uint8], NDArray[np.float32]]]:
    """Frames for `fuse`, without masks; a board of the given step stands in some."""
    path, frames = camera_path(60), []
    for step, board in zip(steps, boards, strict=True):
        things = room() if board is None else [*room(), passer_by(board)]
        rgb, depth, _ = render(things, path[step])
        frames.append((float(step), rgb, depth))
    return frames


def true_poses(steps: list[int]) -> dict[float, Points]:
    return {float(step): np.linalg.inv(camera_path(60)[step]) for step in steps}


def test_who_was_seen_once_or_seen_through_is_left_out() -> None:
    steps = [0, 5, 10, 15, 20]
    stays = fuse(views(steps, [20] * 5), true_poses(steps), CAMERA, 0.02)
    assert on_the_board(stays.points).sum() > 1000, (
        "who never moves and has no mask is part of the room"
    )
    once = fuse(views(steps[:2], [None, 20]), true_poses(steps), CAMERA, 0.02)
    leaves = fuse(views(steps, [20, 20, None, None, None]), true_poses(steps), CAMERA, 0.02)
    for cloud in (once, leaves):
        assert not on_the_board(cloud.points).any()
        assert np.median(off_the_room(cloud.points)) < 0.002
        assert len(cloud) > 5000


def test_a_keyframe_without_a_pose_is_left_out() -> None:
    steps = [0, 5, 10]
    frames = views(steps, [None] * 3)
    without = fuse(frames, true_poses(steps[:2]), CAMERA, 0.02)
    np.testing.assert_array_equal(
        without.points, fuse(frames[:2], true_poses(steps), CAMERA, 0.02).points
    )


def test_depth_is_refused_beside_edges_masks_and_far_away() -> None:
    depth = np.full((40, 100), 2.0, np.float32)
    depth[:, 60:] = 3.0
    depth[:, 90:] = 6.0
    mask = np.zeros(depth.shape, np.bool_)
    mask[:, :10] = True
    kept = filter_depth(remove_dynamic_depth(depth, mask), CAMERA)[20] > 0
    assert np.flatnonzero(kept).tolist() == [*range(10 + 1, 60 - 2), *range(60 + 2, 90 - 2)]


clouds = arrays(
    np.float64, st.tuples(st.integers(1, 60), st.just(3)), elements=st.floats(-50, 50, width=32)
)


@given(clouds, st.integers(0, 1_000_000))
@settings(max_examples=60)
def test_cubes_hold_means_whatever_the_order(points: Points, seed: int) -> None:
    rng = np.random.default_rng(seed)
    grids = [VoxelGrid(0.5) for _ in range(2)]
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
def test_memory_is_bounded_by_larger_cubes(points: Points) -> None:
    grid = VoxelGrid(0.001, limit=8)
    for picture in range(2):
        grid.add(points, np.zeros(points.shape, np.uint8), picture)
    means, _ = grid.cells()
    assert 1 <= len(means) <= 8
    assert len(means) == len(np.unique(np.floor(points / grid.edge), axis=0)), (
        "as if it had been so large at once"
    )


def test_seen_from_above_right_is_right_and_forward_is_up() -> None:
    places = np.array([[0, 1, 4.0], [2, 1, 2.0], [-2, 1, 2.0], [0, -3, 3.0]])
    colors = np.array([[0, 0, 255], [0, 255, 0], [1, 2, 3], [255, 0, 255]], dtype=np.uint8)
    image = render_top_view(PointCloud(places, colors), [np.eye(4)])

    def place(color: list[int]) -> NDArray[np.float64]:
        return np.argwhere((image == color).all(axis=2)).mean(axis=0)

    ahead, right, left = place([0, 0, 255]), place([0, 255, 0]), place([1, 2, 3])
    assert ahead[0] < right[0] == left[0]
    assert left[1] < ahead[1] < right[1]
    assert not (image == colors[3]).all(axis=2).any(), "a ceiling is left out"


def test_a_known_ply_file(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", np.array([[1.0, -2.5, 3.0]]), np.array([[7, 8, 9]], np.uint8))
    points, colors = read_ply(tmp_path / "a.ply")
    assert points.tolist() == [[1.0, -2.5, 3.0]]
    assert colors.tolist() == [[7, 8, 9]]
    assert (
        (tmp_path / "a.ply")
        .read_bytes()
        .endswith(np.array([1, -2.5, 3], "<f4").tobytes() + bytes([7, 8, 9]))
    )
