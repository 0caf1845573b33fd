"""Inverse compositional alignment with known answers, and recognition of places."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_world import poor_view, way_round
from numpy.typing import NDArray
from plane_world import CAMERA, Rectangle, camera_path, render, room, texture

from cohdc_train.slam.config import FeatureConfig, LoopVerificationConfig
from cohdc_train.slam.features.orb import OrbExtractor
from cohdc_train.slam.geometry.depth_image import DepthImage, make_depth_image
from cohdc_train.slam.geometry.se3 import exp_se3, inverse, to_local
from cohdc_train.slam.loop_closing.place_recognition import PlaceRecognizer
from cohdc_train.slam.optimization.image_alignment import align, warp_jacobian

Array = NDArray[np.float64]
PATH = camera_path(20)
CONFIG = LoopVerificationConfig()


def picture(
    T_wc: Array, rectangles: list[Rectangle] | None = None, gain: float = 1.0
) -> DepthImage:
    rgb, depth, moving = render(rectangles or room(), T_wc)
    return make_depth_image((rgb * gain).astype(np.uint8), depth, moving, CAMERA)


@given(st.integers(0, 10_000))
def test_the_warps_jacobian_equals_differences(seed: int) -> None:
    points = np.random.default_rng(seed).uniform([-1, -0.7, 1], [1, 0.7, 4], size=(5, 3))
    jacobian = warp_jacobian(points, CAMERA)
    for axis in range(6):
        ends = [
            CAMERA.project(to_local(exp_se3(sign * 1e-6 * np.eye(6)[axis]), points))
            for sign in (1, -1)
        ]
        np.testing.assert_allclose(
            jacobian[:, :, axis], (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-3
        )


@settings(max_examples=8)
@given(st.integers(0, 1000))
def test_a_small_motion_is_recovered(seed: int) -> None:
    off = np.random.default_rng(seed).uniform(-1, 1, 6) * np.repeat(
        [0.03, 0.015], 3
    )  # 3 cm, 0.9 degrees per axis
    truth = inverse(PATH[19]) @ PATH[0]
    found = align(picture(PATH[0]), picture(PATH[19], gain=0.8), exp_se3(off) @ truth, CONFIG)
    assert found is not None
    rest = found.T @ inverse(truth)
    assert np.linalg.norm(rest[:3, 3]) < 0.003
    assert np.abs(rest[:3, :3] - np.eye(3)).max() < 0.0015
    assert found.after < 0.5 * found.before
    assert found.correlation > 0.97
    assert found.overlap > 0.5
    assert found.agreement > 0.95


def test_the_same_poster_before_another_wall_does_not_correlate() -> None:
    rng = np.random.default_rng(5)
    poster = Rectangle(
        np.array([-0.5, -0.6, 2.5]),
        np.array([1.2, 0, 0]),
        np.array([0, 1.2, 0]),
        texture(rng, 300, 300),
    )
    walls = [
        Rectangle(
            np.array([-3.0, -2.0, 2.6]),
            np.array([6.0, 0, 0]),
            np.array([0, 4.0, 0]),
            texture(rng, 800, 1200),
        )
        for _ in range(2)
    ]
    views = [picture(np.eye(4), [poster, wall]) for wall in walls]
    same, other = (align(views[0], views[k], np.eye(4), CONFIG) for k in (0, 1))
    assert same is not None
    assert other is not None
    assert same.correlation > 0.99
    assert other.correlation < 0.5


def test_pictures_that_see_nothing_in_common_are_refused() -> None:
    away = exp_se3(np.array([0.0, 0, 0, 0, np.pi / 2, 0]))
    assert align(picture(PATH[0]), picture(PATH[0]), away, CONFIG) is None


def test_what_moves_is_not_in_a_picture() -> None:
    rgb, depth, _ = render(room(), PATH[0])
    mask = np.zeros(depth.shape, dtype=np.bool_)
    mask[:, :160] = True
    half = make_depth_image(rgb, depth, mask, CAMERA)
    assert half.depth.shape == half.gray.shape == (120, 160)
    assert not half.depth[:, :80].any()
    assert (half.depth[:, 84:] > 0).mean() > 0.9


@pytest.mark.parametrize("size", [(640, 480), (480, 640), (160, 120)])
def test_a_picture_keeps_the_geometry(size: tuple[int, int]) -> None:
    width, height = size
    camera = type(CAMERA)(500.0, 510.0, width / 2 + 7, height / 2 - 3, width, height, 5000.0)
    small = make_depth_image(
        np.zeros((height, width, 3), dtype=np.uint8),
        np.ones((height, width), dtype=np.float32),
        None,
        camera,
    )
    assert max(small.gray.shape) == 160
    keypoint = np.array(
        [[width - 0.5, height - 0.5]]
    )  # the image's border, seen along the same ray in both
    ray = camera.backproject(keypoint, np.ones(1))
    np.testing.assert_allclose(
        small.camera.project(ray)[0],
        [small.gray.shape[1] - 0.5, small.gray.shape[0] - 0.5],
        atol=1e-9,
    )


def test_a_place_is_recognised_among_others() -> None:
    rng, extract = np.random.default_rng(0), OrbExtractor(CAMERA, FeatureConfig(max_keypoints=300))
    poses = way_round(24, turns=0.95)
    places = PlaceRecognizer()
    for number, pose in enumerate(poses):
        places.add(number, extract(*poor_view(pose, rng)).descriptors)
    nudge = exp_se3(np.array([0.05, 0.02, -0.05, 0.01, 0.03, 0.02]))
    for index in (3, 20):
        similarity = places.similarity(extract(*poor_view(poses[index] @ nudge, rng)).descriptors)
        assert similarity.shape == (24,)
        assert np.argmax(similarity) == index
        apart = np.delete(similarity, range(max(index - 3, 0), index + 4))
        assert similarity[index] > 3 * apart.max()
    for number in range(3):
        places.remove(number)
    there = extract(*poor_view(poses[20] @ nudge, rng)).descriptors
    assert np.argmax(places.similarity(there)) == 17, "the others move up, as the map's do"
