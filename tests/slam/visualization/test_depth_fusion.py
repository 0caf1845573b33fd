"""Dense cloud of a rendered room with walking people, compared with the empty room."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from ply_reader import read_ply

from cohdc_train.slam.run import slam
from cohdc_train.trajectory.association import match
from cohdc_train.trajectory.trajectory import Trajectory

pytest.importorskip("embreex", reason="the renderer comes with the train extra")

from cohdc_train.synth.renderer import render
from cohdc_train.synth.scenario import RenderedScene, draw_scene
from cohdc_train.synth.sequence import sequence

FRAMES, SIZE = 60, (240, 320)


def cloud_in_true_world(run: Path, folder: Path) -> NDArray[np.float64]:
    """Return the cloud of a run [n, 3] m in the world of the ground truth, by the first pose."""
    truth, estimate = match(
        Trajectory.load_tum(folder / "groundtruth.txt"), Trajectory.load_tum(run / "trajectory.txt")
    )
    T = truth.poses[0] @ np.linalg.inv(estimate.poses[0])
    return np.asarray(read_ply(run / "cloud.ply")[0] @ T[:3, :3].T + T[:3, 3])


def errors_and_people(
    points: NDArray[np.float64], scene: RenderedScene
) -> tuple[NDArray[np.float64], int]:
    """Measure the distance of points from the empty room, and count those on people.

    Returns [n] m, the smallest difference in depth over the true views; and the number of points
    that are 10 cm off in each view, but within 10 cm of a person and 20 cm before the room in one.
    """
    atlas, camera = scene.atlas(), scene.camera
    best, people = np.full(len(points), np.inf), np.zeros(len(points), dtype=np.bool_)
    for frame in range(0, FRAMES, 4):
        room = render(scene.room.mesh, atlas, scene.room.lighting, camera, scene.poses[frame]).depth
        full = scene.render_frame(frame, atlas)
        local = (points - scene.poses[frame][:3, 3]) @ scene.poses[frame][:3, :3]
        ahead = np.flatnonzero(local[:, 2] > 0.1)
        x, y, z = local[ahead].T
        u = np.rint(camera.fx * x / z + camera.cx).astype(int)
        v = np.rint(camera.fy * y / z + camera.cy).astype(int)
        inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        ahead, u, v, z = ahead[inside], u[inside], v[inside], z[inside]
        off = z - room[v, u]
        best[ahead] = np.minimum(best[ahead], np.abs(off))
        people[ahead] |= (
            (full.instance[v, u] > 0) & (np.abs(z - full.depth[v, u]) < 0.1) & (off < -0.2)
        )
    return best, int((people & (best > 0.1)).sum())


@pytest.mark.slow
def test_cloud_shows_the_room_without_people(tmp_path: Path) -> None:
    folder = tmp_path / "walk"
    sequence(folder, frames=FRAMES, size=SIZE, people=3)
    scene = draw_scene(0, FRAMES, SIZE, "xyz", 3)
    slam(folder, masks=folder / "masks", out=tmp_path / "run", dense_cloud=True)
    points = cloud_in_true_world(tmp_path / "run", folder)
    errors, people = errors_and_people(points, scene)
    assert len(points) > 20_000
    assert people == 0
    assert np.median(errors) < 0.01
    assert np.mean(errors > 0.1) < 0.001
    for mask in (folder / "masks").iterdir():
        mask.rename(mask.with_suffix(".away"))
    slam(folder, out=tmp_path / "unmasked", dense_cloud=True)
    assert errors_and_people(cloud_in_true_world(tmp_path / "unmasked", folder), scene)[1] > 1000, (
        "people are counted where there are some"
    )
