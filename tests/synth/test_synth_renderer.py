"""Depth, instances and colors of the ray caster against the geometry of planes and spheres."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.synth import mesh as solids
from cohdc_train.synth.renderer import Atlas, RenderCamera, cast_rays, rays, render
from cohdc_train.synth.room import Lighting

pytest.importorskip("embreex")

GRAY = np.full((64, 64, 3), 128, dtype=np.uint8)
LIGHT = Lighting(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.float32), np.ones(3, np.float32))
CAMERA = RenderCamera.freiburg3((60, 80))


def looking_at_z() -> np.ndarray:
    return np.eye(4)


@settings(max_examples=25, deadline=None)
@given(
    distance=st.floats(0.5, 6.0),
    slope_x=st.floats(-0.6, 0.6),
    slope_y=st.floats(-0.6, 0.6),
    position=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
)
def test_depth_of_a_plane(
    distance: float, slope_x: float, slope_y: float, position: tuple[float, float, float]
) -> None:
    # the plane z = distance + slope_x x + slope_y y, seen from `position`
    corner = np.array([-40.0, -40.0, distance - 40 * slope_x - 40 * slope_y])
    plane = solids.quad(corner, (80, 0, 80 * slope_x), (0, 80, 80 * slope_y), 0)
    pose = looking_at_z()
    pose[:3, 3] = position
    hits = cast_rays(plane, CAMERA, pose)
    d = rays(CAMERA).astype(float)
    x, y, z = position
    expected = (distance + slope_x * x + slope_y * y - z) / (
        1 - slope_x * d[:, 0] - slope_y * d[:, 1]
    )
    inside = (expected > 0) & (expected < 30)
    assert inside.any()
    np.testing.assert_allclose(hits.depth[inside], expected[inside], rtol=2e-4)


def test_ball_covers_its_circle_in_instance_image() -> None:
    ball = solids.ellipsoid((0, 0, 3), (0.5, 0.5, 0.5), 0).as_instance(7, 0)
    camera = RenderCamera(200, 200, 99.5, 99.5, 200, 200)
    found = render(ball, Atlas([GRAY] * 8), LIGHT, camera, looking_at_z()).instance
    assert set(np.unique(found)) == {0, 7}
    radius = 200 * 0.5 / np.sqrt(3**2 - 0.5**2)
    assert 0.9 < (found == 7).sum() / (np.pi * radius**2) < 1.0, (
        "the mesh is inscribed in the sphere"
    )


def test_nearest_instance_is_visible_and_background_is_zero() -> None:
    near = solids.quad((-0.2, -0.2, 1), (0.4, 0, 0), (0, 0.4, 0), 0).as_instance(2, 0)
    far = solids.quad((-0.6, -0.6, 2), (1.2, 0, 0), (0, 1.2, 0), 0).as_instance(1, 0)
    view = render(solids.join_meshes([far, near]), Atlas([GRAY]), LIGHT, CAMERA, looking_at_z())
    assert view.instance[30, 40] == 2
    assert view.depth[30, 40] == pytest.approx(1.0, abs=1e-5)
    assert view.instance[15, 40] == 1
    assert view.instance[0, 0] == 0
    assert view.depth[0, 0] == 0
    np.testing.assert_array_equal(view.depth == 0, view.instance == 0)
    np.testing.assert_array_equal(view.rgb.sum(axis=2) == 0, view.instance == 0)


def test_texture_is_upright_at_every_distance() -> None:
    texture = np.zeros((64, 128, 3), dtype=np.uint8)
    texture[:32, 64:] = (200, 0, 0)  # upper right
    texture[32:, :64] = (0, 0, 200)  # lower left
    for distance in (1.0, 3.0, 6.0):
        wall = solids.quad((-1, -1, distance), (2, 0, 0), (0, 2, 0), 0)
        view = render(wall, Atlas([GRAY, texture]), LIGHT, CAMERA, looking_at_z())
        assert view.rgb.max() < 0.6, "the first texture is gray"
        view = render(wall.as_instance(0, 1), Atlas([GRAY, texture]), LIGHT, CAMERA, looking_at_z())
        u, v = CAMERA.fx * 0.4 / distance, CAMERA.fy * 0.4 / distance
        right, left = int(CAMERA.cx + u), int(CAMERA.cx - u)
        top, bottom = int(CAMERA.cy - v), int(CAMERA.cy + v)
        ambient = 0.82 - 0.18  # the wall looks down the z axis
        np.testing.assert_allclose(
            view.rgb[top, right], np.array([200, 0, 0]) / 255 * ambient, atol=0.02
        )
        np.testing.assert_allclose(
            view.rgb[bottom, left], np.array([0, 0, 200]) / 255 * ambient, atol=0.02
        )
        np.testing.assert_allclose(view.rgb[top, left], 0, atol=0.02)


def test_lamp_lights_by_cosine_and_distance() -> None:
    lamp = Lighting(
        np.array([[0, 0, 1.0]], np.float32), np.ones((1, 3), np.float32), np.zeros(3, np.float32)
    )
    wall = solids.quad((-4, -4, 2), (8, 0, 0), (0, 8, 0), 0)
    view = render(wall, Atlas([GRAY]), lamp, RenderCamera(50, 50, 40, 30, 80, 60), looking_at_z())
    middle = 128 / 255 / (1 + 0.12)
    np.testing.assert_allclose(view.rgb[30, 40], middle, rtol=0.01)
    aside = (
        128 / 255 * np.sqrt(0.5) / (1 + 0.12 * 2)
    )  # 25 px to the right: 1 m aside, at 45 degrees
    np.testing.assert_allclose(view.rgb[30, 65], aside, rtol=0.01)


def test_resized_camera_sees_the_same_view() -> None:
    camera = RenderCamera.freiburg3((480, 640))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(
        (535.4, 539.2, 320.1, 247.6)
    )
    double = camera.resized(2)
    coarse = rays(camera).reshape(480, 640, 3)
    fine = rays(double).reshape(480, 2, 640, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(fine, coarse, atol=1e-5)
