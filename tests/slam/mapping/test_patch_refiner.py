"""Photometric refinement against known shifts and affine maps."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plane_world import CAMERA, Rectangle, camera_path, render, room, slam_config, texture, track

from cohdc_train.slam.config import FeatureConfig, RefinementConfig
from cohdc_train.slam.features.keypoints import ScalePyramid
from cohdc_train.slam.features.matching import Matches
from cohdc_train.slam.features.orb import OrbExtractor, gray_of
from cohdc_train.slam.features.patch_alignment import Pyramid, align, warp_patches
from cohdc_train.slam.geometry.se3 import Array, exp_se3, inverse, to_local
from cohdc_train.slam.mapping.keyframe import observations_at
from cohdc_train.slam.mapping.patch_refiner import PatchRefiner, affine
from cohdc_train.slam.system import Slam

IMAGE = cv2.cvtColor(
    cv2.GaussianBlur(texture(np.random.default_rng(0), 240, 320), (0, 0), 1.5), cv2.COLOR_RGB2GRAY
)
REFINEMENT = RefinementConfig()
PYRAMID = Pyramid(np.asarray(IMAGE, dtype=np.uint8), ScalePyramid(), REFINEMENT.max_level)
KEYPOINTS = OrbExtractor(CAMERA, FeatureConfig(max_keypoints=150))(
    cv2.cvtColor(IMAGE, cv2.COLOR_GRAY2RGB), np.ones((240, 320), np.float32)
)
INSIDE = ((KEYPOINTS.pixels > 60) & (KEYPOINTS.pixels < (260, 180))).all(axis=1) & (
    KEYPOINTS.octaves <= 4
)


@settings(max_examples=25)
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.7, 1.3), st.floats(-30, 30))
def test_alignment_recovers_shift_under_changed_lighting(
    x: float, y: float, gain: float, offset: float
) -> None:
    """The median error is below a tenth of a pixel of the level, with few outliers."""
    pixels, octaves = KEYPOINTS.pixels[INSIDE], KEYPOINTS.octaves[INSIDE]
    template = gain * PYRAMID.cut(pixels, octaves, 10).reshape(-1, 10, 10) + offset
    scale = 1.2**octaves
    shift, is_aligned = align(
        PYRAMID,
        pixels + np.array([x, y]) * scale[:, None],
        octaves,
        np.asarray(template, np.float32),
        REFINEMENT,
    )
    assert is_aligned.mean() > 0.6
    error = np.linalg.norm(shift[is_aligned] + (x, y), axis=1)
    assert np.median(error) < 0.1
    assert (error > 0.5).mean() < 0.1


def test_blank_and_foreign_patches_are_not_aligned() -> None:
    pixels, octaves = KEYPOINTS.pixels[INSIDE][:8], KEYPOINTS.octaves[INSIDE][:8]
    assert not align(PYRAMID, pixels, octaves, np.full((8, 10, 10), 99, np.float32), REFINEMENT)[
        1
    ].any()
    noise = np.random.default_rng(1).uniform(0, 255, (8, 10, 10)).astype(np.float32)
    assert not align(PYRAMID, pixels, octaves, noise, REFINEMENT)[1].any()


def test_warp_rotates_and_scales_patch() -> None:
    ramp = np.broadcast_to(np.arange(16, dtype=np.uint8) * 10, (1, 16, 16))
    quarter = np.array([[[0.0, -1.0], [1.0, 0.0]]])  # x of the patch is -y of the image
    np.testing.assert_allclose(
        warp_patches(ramp, quarter, 8)[0, :, 0], np.arange(110, 30, -10), atol=1e-3
    )
    np.testing.assert_allclose(
        warp_patches(ramp, 0.5 * np.eye(2)[None], 8)[0, 0], 75 + 5 * (np.arange(8) - 3.5), atol=1e-3
    )


@pytest.fixture
def slam() -> Slam:
    """Return a system with one keyframe of a wall that is parallel to its image."""
    slam = Slam(CAMERA, slam_config(200))
    track(slam, FIRST_VIEW, FIRST_DEPTH, 0.0)
    return slam


WALL_TEXTURE = texture(np.random.default_rng(3), 600, 900)
WALL = Rectangle(
    np.array([-3.0, -2.0, 2.6]), np.array([6.0, 0, 0]), np.array([0, 4.0, 0]), WALL_TEXTURE
)
FIRST_VIEW, FIRST_DEPTH, _ = render([WALL], np.eye(4))


def test_affine_map_equals_derivative_of_projection(slam: Slam) -> None:
    """A pixel of the first keyframe is moved at the point's depth, and projected into a camera."""
    world, T_cw = slam.map, exp_se3(np.array([0.2, -0.1, 0.3, 0.1, -0.2, 0.4]))
    ids = np.arange(50)

    def projected(points: Array) -> Array:
        return CAMERA.project(to_local(T_cw, points))

    first = CAMERA.project(world.positions[ids])
    A, tiny = affine(world, ids, T_cw), 1e-4
    for axis in range(2):
        moved = CAMERA.backproject(first + tiny * np.eye(2)[axis], world.positions[ids, 2])
        np.testing.assert_allclose(
            A[:, :, axis], (projected(moved) - projected(world.positions[ids])) / tiny, atol=1e-3
        )


def test_refinement_keeps_rolling_shutter_correction(slam: Slam) -> None:
    keyframe = slam.map.keyframes[0]
    keypoints = np.flatnonzero(keyframe.point_ids >= 0)
    matches, features = Matches(keyframe.point_ids[keypoints], keypoints), keyframe.features
    refiner = PatchRefiner(slam.map, REFINEMENT)
    pyramid = refiner.pyramid(gray_of(FIRST_VIEW))
    refiner.store(keyframe, pyramid)
    shifted = replace(features, pixels=features.pixels + 0.4)
    refined = [
        refiner.refine(
            replace(shifted, undistorted=shifted.undistorted + shift),
            matches,
            keyframe.T_cw,
            pyramid,
        ).undistorted
        for shift in (0.0, 3.0)
    ]
    assert (refined[0] != keyframe.features.undistorted).any()
    np.testing.assert_allclose(refined[1] - refined[0], 3.0)


def test_keypoints_in_another_image_are_not_refined(slam: Slam) -> None:
    """The keypoints keep their positions in an image that shows something else."""
    keyframe = slam.map.keyframes[0]
    keypoints = np.flatnonzero(keyframe.point_ids >= 0)
    matches, refiner = Matches(keyframe.point_ids[keypoints], keypoints), slam.tracker.parts.refiner
    assert refiner is not None
    for image, least, most in (
        (FIRST_VIEW, 0.5, 1.0),
        (np.ascontiguousarray(FIRST_VIEW[::-1]), 0.0, 0.05),
    ):
        pyramid = refiner.pyramid(gray_of(image))
        found = refiner.refine(keyframe.features, matches, keyframe.T_cw, pyramid)
        assert least <= found.is_subpixel.mean() <= most
        np.testing.assert_array_equal(
            found.pixels[~found.is_subpixel], keyframe.features.pixels[~found.is_subpixel]
        )


def test_point_without_patch_does_not_reuse_patch_of_removed_point(slam: Slam) -> None:
    world, refiner = slam.map, slam.tracker.parts.refiner
    assert refiner is not None
    is_coarse = world.keyframes[0].features.octaves > 4
    ids = world.keyframes[0].point_ids
    refiner._patches[:] = 77  # of removed points in these rows
    refiner.store(world.keyframes[0], refiner.pyramid(gray_of(FIRST_VIEW)))
    assert (refiner._patches[ids[is_coarse & (ids >= 0)]] == 0).all()
    assert refiner._patches[ids[~is_coarse & (ids >= 0)]].std() > 10


def test_patch_with_one_edge_is_not_aligned() -> None:
    x, y = np.meshgrid(np.arange(10), np.arange(10))
    edge = np.where(x + y > 9, 200, 20).astype(np.float32)[None]
    assert not align(PYRAMID, KEYPOINTS.pixels[:1], KEYPOINTS.octaves[:1], edge, REFINEMENT)[
        1
    ].any()


def test_relocalized_pose_is_independent_of_prediction() -> None:
    """A camera at rest jumps elsewhere; its hundred points determine the pose, not the prior."""
    slam = Slam(CAMERA, slam_config(150, loops__enabled=False, keyframe_culling__enabled=False))
    yaws = [*np.linspace(0, 0.55, 28), *([0.55] * 12)]
    path = [exp_se3(np.array([0, 0, 0, 0, yaw, 0])) for yaw in yaws] + [
        exp_se3(np.array([0.1, 0, 0, 0, 0.05, 0]))
    ]
    poses = [track(slam, *render(room(), T_wc)[:2], k / 30) for k, T_wc in enumerate(path)]
    assert poses[-1].T_wc is not None
    assert poses[-1].num_matches < 150
    assert np.linalg.norm(poses[-1].T_wc[:3, 3] - path[-1][:3, 3]) < 0.02


def test_refinement_reduces_reprojection_error_of_map() -> None:
    """The median reprojection error of twelve views falls by at least a fifth."""
    median_errors = []
    for refines in (False, True):
        slam = Slam(CAMERA, slam_config(300, refinement__enabled=refines))
        for k, pose in enumerate(camera_path(48)[::4]):
            assert track(slam, *render(room(), pose)[:2], k / 30).is_tracked
        errors = []
        for keyframe in slam.map.keyframes[1:]:
            keypoints = np.flatnonzero(keyframe.point_ids >= 0)
            keypoints = keypoints[
                slam.map.first_keyframe[keyframe.point_ids[keypoints]] < keyframe.index
            ]
            local = to_local(keyframe.T_cw, slam.map.positions[keyframe.point_ids[keypoints]])
            errors.append(
                np.linalg.norm(
                    CAMERA.project(local) - keyframe.features.undistorted[keypoints], axis=1
                )
            )
        median_errors.append(np.median(np.concatenate(errors)))
    assert median_errors[1] < 0.8 * median_errors[0]


def test_refinement_halves_trajectory_error() -> None:
    """Sixty noisy views have at most half the error of keypoints at integer pixel positions."""
    errors = []
    for refines in (False, True):
        config = slam_config(300, refinement__enabled=refines, smoothing__enabled=False)
        rng, slam, path = (
            np.random.default_rng(5),
            Slam(CAMERA, config),
            camera_path(60),
        )
        for k, pose in enumerate(path):
            rgb, depth, _ = render(room(), pose)
            noisy = np.clip(rgb + rng.normal(0, 3, rgb.shape), 0, 255).astype(np.uint8)
            assert track(slam, noisy, depth, k / 30).is_tracked
        slam.finish()
        truth = inverse(path[0]) @ np.stack(path)
        errors.append(
            np.sqrt(((slam.trajectory().poses[:, :3, 3] - truth[:, :3, 3]) ** 2).sum(axis=1).mean())
        )
    assert errors[1] < 0.5 * errors[0]


def test_only_refined_keypoints_have_smaller_sigma(slam: Slam) -> None:
    """A keypoint that observes a point later is not refined until it is aligned."""
    keyframe = slam.map.keyframes[0]
    points = (keyframe.point_ids >= 0) & (keyframe.features.octaves <= 4)
    assert keyframe.features.is_subpixel[points].all()
    assert (keyframe.features.sigmas[points] < 0.5 * keyframe.features.scales[points]).all()
    assert not keyframe.features.is_subpixel[~points].any(), (
        "keypoints of coarse levels are not refined"
    )
    measured = observations_at(keyframe.features, np.arange(len(points)))
    np.testing.assert_array_equal(measured.sigmas, keyframe.features.sigmas)
    np.testing.assert_array_equal(
        measured.depth_sigmas, keyframe.features.scales, err_msg="refinement does not improve depth"
    )
    others = keyframe.features.without_subpixel
    np.testing.assert_array_equal(
        others.sigmas, keyframe.features.scales, err_msg="other points are not refined"
    )
    assert keyframe.features.is_subpixel[points].all()
    matches = Matches(keyframe.point_ids[points][:1], np.flatnonzero(points)[:1])
    slam.map.forget(keyframe, matches.keypoints)
    slam.map.observe(keyframe, matches)
    assert not keyframe.features.is_subpixel[matches.keypoints].any()
