"""tools/compose_people: a cut-out stands where geometry says, moves with the world, and hides
behind what is nearer.
"""

from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from tool_loader import load_tool

from cohdc_train.slam.geometry.camera import Camera
from cohdc_train.slam.io.tum import TimestampedImage

pytest.importorskip("torch", reason="the tool reads people from COCO folders with the train extra")
CAMERA = Camera(200.0, 200.0, 79.5, 59.5, 160, 120, 5000.0)
# Looks along the world's y from 1.5 m above the floor.
LEVEL = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    return load_tool("compose_people")


def standing(tool: ModuleType, distance: float, swing: float = 0.0) -> tuple[object, object]:
    """A red person of .6 x 1.2 m whose head is at 1.75 m, and the way across the view."""
    rgb = np.full((400, 200, 3), (250, 0, 0), np.uint8)
    person = tool.CutOut.of(rgb, np.ones((400, 200), bool))
    x, y = np.eye(3)[:2]
    return person, tool.Way(distance * y, x, -y, swing, 4.0, 0.0)


def test_a_person_covers_what_geometry_says(tool: ModuleType) -> None:
    person, way = standing(tool, 4.0)
    layers, depth = tool.seen(person, way, 0.0, LEVEL, tool.rays(CAMERA, 1))
    rows, columns = np.nonzero(np.isfinite(depth) & (layers[..., 3] > 0.5))
    assert columns.min() == pytest.approx(79.5 - 0.3 / 4 * 200, abs=1.5)
    assert columns.max() == pytest.approx(79.5 + 0.3 / 4 * 200, abs=1.5)
    assert rows.min() == pytest.approx(59.5 - 0.25 / 4 * 200, abs=1.5)
    assert rows.max() == pytest.approx(59.5 + 0.95 / 4 * 200, abs=1.5)
    assert depth[78, 79] == pytest.approx(4.0 - tool.RELIEF, abs=0.02)
    assert depth[78, columns.min() + 1] > depth[78, 79] + 0.05, "a body is round"


def test_a_person_walks_in_the_world_not_with_the_camera(tool: ModuleType) -> None:
    person, way = standing(tool, 2.0, swing=0.5)
    moved = LEVEL.copy()
    moved[0, 3] = 0.5
    directions = tool.rays(CAMERA, 1)

    def middle(t: float, pose: np.ndarray) -> float:
        return float(
            np.nonzero(np.isfinite(tool.seen(person, way, t, pose, directions)[1]))[1].mean()
        )

    assert middle(0.0, LEVEL) == pytest.approx(79.5, abs=1)
    assert middle(1.0, LEVEL) == pytest.approx(79.5 + 0.5 / 2 * 200, abs=1)
    assert middle(1.0, moved) == pytest.approx(79.5, abs=1)


def test_what_is_nearer_hides_a_person_and_the_rest_stays_as_it_was(
    tool: ModuleType, tmp_path: Path
) -> None:
    depth = np.full((120, 160), 15000, np.uint16)  # a wall 3 m away
    depth[60:] = 5000  # and a table 1 m away
    depth[:, :20] = 0
    cv2.imwrite(str(tmp_path / "d.png"), depth)
    cv2.imwrite(str(tmp_path / "c.png"), np.full((120, 160, 3), 120, np.uint8))
    color, depth_image = tmp_path / "c.png", tmp_path / "d.png"
    frame = TimestampedImage(0.0, "0", color), TimestampedImage(0.0, "0", depth_image)
    layers = [tool.seen(*standing(tool, 2.0), 0.0, LEVEL, tool.rays(CAMERA, 1))]
    rgb, units, mask = tool.compose(frame, CAMERA, layers, np.random.default_rng(0))
    assert mask[:58].any()
    assert not mask[60:].any()
    assert rgb[50, 79, 0] > rgb[50, 79, 1] + 60
    assert units[50, 79] == pytest.approx(5000 * (2 - tool.RELIEF), rel=0.05)
    away = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    assert np.array_equal(units[away], depth[away])
    assert (rgb[away] == 120).all()
