"""Inverse compositional alignment of images with known motion."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from plane_world import CAMERA, Rectangle, camera_path, render, room, texture

from cohdc_train.slam.config import LoopVerificationConfig
from cohdc_train.slam.geometry.depth_image import DepthImage, make_depth_image
from cohdc_train.slam.geometry.se3 import exp_se3, inverse, to_local
from cohdc_train.slam.optimization.image_alignment import align, warp_jacobian

Array = NDArray[np.float64]
PATH = camera_path(20)
CONFIG = LoopVerificationConfig()


def depth_image(
    T_wc: Array, rectangles: list[Rectangle] | None = None, gain: float = 1.0
) -> DepthImage:
    rgb, depth, moving = render(rectangles or room(), T_wc)
    return make_depth_image((rgb * gain).astype(np.uint8), depth, moving, CAMERA)


@given(st.integers(0, 10_000))
def test_warp_jacobian_equals_finite_differences(seed: int) -> None:
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
def test_alignment_recovers_small_motion(seed: int) -> None:
    off = np.random.default_rng(seed).uniform(-1, 1, 6) * np.repeat(
        [0.03, 0.015], 3
    )  # 3 cm and 0.9 degrees per axis
    truth = inverse(PATH[19]) @ PATH[0]
    found = align(
        depth_image(PATH[0]), depth_image(PATH[19], gain=0.8), exp_se3(off) @ truth, CONFIG
    )
    assert found is not None
    remaining = found.T @ inverse(truth)
    assert np.linalg.norm(remaining[:3, 3]) < 0.003
    assert np.abs(remaining[:3, :3] - np.eye(3)).max() < 0.0015
    assert found.after < 0.5 * found.before
    assert found.correlation > 0.97
    assert found.overlap > 0.5
    assert found.agreement > 0.95


def test_same_object_in_front_of_another_wall_does_not_correlate() -> None:
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
    views = [depth_image(np.eye(4), [poster, wall]) for wall in walls]
    same, other = (align(views[0], views[k], np.eye(4), CONFIG) for k in (0, 1))
    assert same is not None
    assert other is not None
    assert same.correlation > 0.99
    assert other.correlation < 0.5


def test_images_without_overlap_are_refused() -> None:
    away = exp_se3(np.array([0.0, 0, 0, 0, np.pi / 2, 0]))
    assert align(depth_image(PATH[0]), depth_image(PATH[0]), away, CONFIG) is None
