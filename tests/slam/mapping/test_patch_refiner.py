"""Photometric refinement: known shifts, known affine maps, and what must stay where it is."""

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
from cohdc_train.slam.mapping.keyframe import observations
from cohdc_train.slam.mapping.patch_refiner import PatchRefiner, affine
from cohdc_train.slam.system import Slam

PICTURE = cv2.cvtColor(
    cv2.GaussianBlur(texture(np.random.default_rng(0), 240, 320), (0, 0), 1.5), cv2.COLOR_RGB2GRAY
)
REFINEMENT = RefinementConfig()
PYRAMID = Pyramid(np.asarray(PICTURE, dtype=np.uint8), ScalePyramid(), REFINEMENT.max_level)
CORNERS = OrbExtractor(CAMERA, FeatureConfig(max_keypoints=150))(
    cv2.cvtColor(PICTURE, cv2.COLOR_GRAY2RGB), np.ones((240, 320), np.float32)
)
INSIDE = ((CORNERS.pixels > 60) & (CORNERS.pixels < (260, 180))).all(axis=1) & (
    CORNERS.octaves <= 4
)


@settings(max_examples=25)
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.7, 1.3), st.floats(-30, 30))
def test_a_patch_goes_back_to_where_it_was_cut_out(
    x: float, y: float, gain: float, offset: float
) -> None:
    """Whatever the light: by a tenth of a pixel of its level in the median, and few are misled."""
    pixels, octaves = CORNERS.pixels[INSIDE], CORNERS.octaves[INSIDE]
    template = gain * PYRAMID.cut(pixels, octaves, 10).reshape(-1, 10, 10) + offset
    scale = 1.2**octaves
    shift, good = align(
        PYRAMID,
        pixels + np.array([x, y]) * scale[:, None],
        octaves,
        np.asarray(template, np.float32),
        REFINEMENT,
    )
    assert good.mean() > 0.6
    error = np.linalg.norm(shift[good] + (x, y), axis=1)
    assert np.median(error) < 0.1
    assert (error > 0.5).mean() < 0.1


def test_a_blank_patch_and_a_stranger_stay() -> None:
    pixels, octaves = CORNERS.pixels[INSIDE][:8], CORNERS.octaves[INSIDE][:8]
    assert not align(PYRAMID, pixels, octaves, np.full((8, 10, 10), 99, np.float32), REFINEMENT)[
        1
    ].any()
    noise = np.random.default_rng(1).uniform(0, 255, (8, 10, 10)).astype(np.float32)
    assert not align(PYRAMID, pixels, octaves, noise, REFINEMENT)[1].any()


def test_a_patch_is_turned_and_scaled() -> None:
    ramp = np.broadcast_to(np.arange(16, dtype=np.uint8) * 10, (1, 16, 16))
    quarter = np.array([[[0.0, -1.0], [1.0, 0.0]]])  # x of the patch is minus y of the image
    np.testing.assert_allclose(
        warp_patches(ramp, quarter, 8)[0, :, 0], np.arange(110, 30, -10), atol=1e-3
    )
    np.testing.assert_allclose(
        warp_patches(ramp, 0.5 * np.eye(2)[None], 8)[0, 0], 75 + 5 * (np.arange(8) - 3.5), atol=1e-3
    )


@pytest.fixture
def slam() -> Slam:
    """One keyframe of a wall that faces it."""
    slam = Slam(CAMERA, slam_config(200))
    track(slam, FIRST_VIEW, FIRST_DEPTH, 0.0)
    return slam


PICTURE_RGB = texture(np.random.default_rng(3), 600, 900)
WALL = Rectangle(
    np.array([-3.0, -2.0, 2.6]), np.array([6.0, 0, 0]), np.array([0, 4.0, 0]), PICTURE_RGB
)
FIRST_VIEW, FIRST_DEPTH, _ = render([WALL], np.eye(4))


def test_the_affine_map_is_the_projections_derivative(slam: Slam) -> None:
    """One pixel to the side in the keyframe, at the point's depth there, and where that lies in the
    other camera.
    """
    world, T_cw = slam.map, exp_se3(np.array([0.2, -0.1, 0.3, 0.1, -0.2, 0.4]))
    ids = np.arange(50)

    def seen(points: Array) -> Array:
        return CAMERA.project(to_local(T_cw, points))

    first = CAMERA.project(world.positions[ids])
    A, tiny = affine(world, ids, T_cw), 1e-4
    for axis in range(2):
        moved = CAMERA.backproject(first + tiny * np.eye(2)[axis], world.positions[ids, 2])
        np.testing.assert_allclose(
            A[:, :, axis], (seen(moved) - seen(world.positions[ids])) / tiny, atol=1e-3
        )


def test_what_a_rolling_shutter_moved_stays_moved(slam: Slam) -> None:
    keyframe = slam.map.keyframes[0]
    keypoints = np.flatnonzero(keyframe.point_ids >= 0)
    matches, features = Matches(keyframe.point_ids[keypoints], keypoints), keyframe.features
    refiner = PatchRefiner(slam.map, REFINEMENT)
    pyramid = refiner.pyramid(gray_of(FIRST_VIEW))
    refiner.store(keyframe, pyramid)
    aside = replace(features, pixels=features.pixels + 0.4)
    refined = [
        refiner.refine(
            replace(aside, undistorted=aside.undistorted + shift), matches, keyframe.T_cw, pyramid
        ).undistorted
        for shift in (0.0, 3.0)
    ]
    assert (refined[0] != keyframe.features.undistorted).any()
    np.testing.assert_allclose(refined[1] - refined[0], 3.0)


def test_what_fits_nowhere_is_not_precise(slam: Slam) -> None:
    """The same corners where the picture shows something else: none counts for more than it did."""
    keyframe = slam.map.keyframes[0]
    keypoints = np.flatnonzero(keyframe.point_ids >= 0)
    matches, refiner = Matches(keyframe.point_ids[keypoints], keypoints), slam.tracker.parts.refiner
    assert refiner is not None
    for picture, least, most in (
        (FIRST_VIEW, 0.5, 1.0),
        (np.ascontiguousarray(FIRST_VIEW[::-1]), 0.0, 0.05),
    ):
        pyramid = refiner.pyramid(gray_of(picture))
        found = refiner.refine(keyframe.features, matches, keyframe.T_cw, pyramid)
        assert least <= found.is_subpixel.mean() <= most
        np.testing.assert_array_equal(
            found.pixels[~found.is_subpixel], keyframe.features.pixels[~found.is_subpixel]
        )


def test_a_point_without_a_patch_does_not_take_over_a_former_one(slam: Slam) -> None:
    world, refiner = slam.map, slam.tracker.parts.refiner
    assert refiner is not None
    wide = world.keyframes[0].features.octaves > 4
    ids = world.keyframes[0].point_ids
    refiner._patches[:] = 77  # of points that once had these rows
    refiner.store(world.keyframes[0], refiner.pyramid(gray_of(FIRST_VIEW)))
    assert (refiner._patches[ids[wide & (ids >= 0)]] == 0).all()
    assert refiner._patches[ids[~wide & (ids >= 0)]].std() > 10


def test_a_patch_with_one_edge_is_no_error() -> None:
    x, y = np.meshgrid(np.arange(10), np.arange(10))
    edge = np.where(x + y > 9, 200, 20).astype(np.float32)[None]
    assert not align(PYRAMID, CORNERS.pixels[:1], CORNERS.octaves[:1], edge, REFINEMENT)[1].any()


def test_a_place_found_anew_owes_nothing_to_where_it_was_expected() -> None:
    """A camera at rest that is carried off at once: what it sees, some hundred points, says where
    it is.
    """
    slam = Slam(CAMERA, slam_config(150, loops__enabled=False, keyframe_culling__enabled=False))
    yaws = [*np.linspace(0, 0.55, 28), *([0.55] * 12)]
    path = [exp_se3(np.array([0, 0, 0, 0, yaw, 0])) for yaw in yaws] + [
        exp_se3(np.array([0.1, 0, 0, 0, 0.05, 0]))
    ]
    poses = [track(slam, *render(room(), T_wc)[:2], k / 30) for k, T_wc in enumerate(path)]
    assert poses[-1].T_wc is not None
    assert poses[-1].num_matches < 150
    assert np.linalg.norm(poses[-1].T_wc[:3, 3] - path[-1][:3, 3]) < 0.02


def test_a_map_of_refined_measurements_fits_better() -> None:
    """Twelve views of a room: what bundle adjustment leaves over, in the median, falls by a fifth
    and more.
    """
    left = []
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
        left.append(np.median(np.concatenate(errors)))
    assert left[1] < 0.8 * left[0]


def test_frames_are_placed_by_a_fraction_of_the_error() -> None:
    """Sixty views of a room whose pictures are noisy: half the error of corners on whole pixels,
    and less.
    """
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


def test_only_what_a_patch_was_held_against_is_precise(slam: Slam) -> None:
    """Where a point was born its patch lies exactly; a corner that becomes its measurement later
    may be off.
    """
    keyframe = slam.map.keyframes[0]
    points = (keyframe.point_ids >= 0) & (keyframe.features.octaves <= 4)
    assert keyframe.features.is_subpixel[points].all()
    assert (keyframe.features.sigmas[points] < 0.5 * keyframe.features.scales[points]).all()
    assert not keyframe.features.is_subpixel[~points].any(), "wide patches are seldom flat"
    measured = observations(keyframe.features, np.arange(len(points)))
    np.testing.assert_array_equal(measured.sigmas, keyframe.features.sigmas)
    np.testing.assert_array_equal(
        measured.depth_sigmas, keyframe.features.scales, err_msg="depth is no better known"
    )
    others = keyframe.features.without_subpixel
    np.testing.assert_array_equal(
        others.sigmas, keyframe.features.scales, err_msg="of other points nothing more is known"
    )
    assert keyframe.features.is_subpixel[points].all()
    matches = Matches(keyframe.point_ids[points][:1], np.flatnonzero(points)[:1])
    slam.map.forget(keyframe, matches.keypoints)
    slam.map.observe(keyframe, matches)
    assert not keyframe.features.is_subpixel[matches.keypoints].any()
