"""Bodies: on the floor, of the right height, articulated, with outward normals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cohdc_train.synth.people import Person, draw_person, draw_pose, person_mesh, stride, walking
from cohdc_train.synth.random_streams import stream


@pytest.fixture(scope="module")
def person() -> Person:
    return draw_person(np.random.default_rng(3))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_body_in_any_pose_stands_on_floor(seed: int) -> None:
    rng = np.random.default_rng(seed)
    someone, pose = draw_person(rng), draw_pose(rng)
    mesh = person_mesh(someone, pose, (1.0, -2.0), 0.7)
    z = mesh.corners[..., 2]
    assert np.isfinite(mesh.corners).all()
    assert z.min() == pytest.approx(0, abs=0.012 * someone.height)
    assert (
        0.85 * someone.height < z.max() < 1.35 * someone.height
    )  # above the head only with a raised hand
    middle = mesh.corners.reshape(-1, 3)[:, :2].mean(axis=0)
    assert np.hypot(*(middle - (1.0, -2.0))) < 0.5
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-3)
    assert set(np.unique(mesh.texture)) <= set(range(6))


def test_standing_height(person: Person) -> None:
    top = person_mesh(person, walking(0.0, 0.0), (0, 0), 0).corners[..., 2].max()
    assert top == pytest.approx(person.height, rel=0.05)


def test_normals_point_out_of_the_body(person: Person) -> None:
    mesh = person_mesh(person, walking(1.0), (0, 0), 0)
    edges = mesh.corners[:, 1:] - mesh.corners[:, :1]
    faces = np.cross(edges[:, 0], edges[:, 1])
    agree = np.einsum("ij,ij->i", faces, mesh.normals.mean(axis=1))
    area = np.linalg.norm(faces, axis=1)
    big = area > np.quantile(area, 0.2)
    assert len(set(np.sign(agree[big]))) == 1, "one winding for the whole body"
    front = mesh.corners.reshape(-1, 3)[:, 0].argmax()
    assert mesh.normals.reshape(-1, 3)[front, 0] > 0.5


def test_walk_is_a_cycle_whose_halves_mirror(person: Person) -> None:
    here = person_mesh(person, walking(0.4), (0, 0), 0).corners
    np.testing.assert_allclose(
        here, person_mesh(person, walking(0.4 + 2 * np.pi), (0, 0), 0).corners, atol=1e-5
    )
    other = person_mesh(person, walking(0.4 + np.pi), (0, 0), 0).corners
    assert np.abs(here - other).max() > 0.3
    # mirrored left to right, the half cycle later has the same extent
    np.testing.assert_allclose(here[..., 1].max(), -other[..., 1].min(), atol=0.02)
    assert 1.0 < stride(person) < 1.7


def test_heading_turns_the_body(person: Person) -> None:
    ahead = person_mesh(person, walking(0.8), (0, 0), 0.0).corners
    left = person_mesh(person, walking(0.8), (0, 0), np.pi / 2).corners
    np.testing.assert_allclose(left[..., 1], ahead[..., 0], atol=1e-5)
    np.testing.assert_allclose(left[..., 0], -ahead[..., 1], atol=1e-5)


def test_streams_share_no_people() -> None:
    drawn = [
        draw_person(stream(0, *key))
        for key in (("coco-train", 0), ("coco-val", 0), ("sequence", 0), ("coco-train", 1))
    ]
    for i, a in enumerate(drawn):
        for b in drawn[:i]:
            assert a.height != b.height
            assert all(
                not np.array_equal(x, y) for x, y in zip(a.textures, b.textures, strict=True)
            )
