"""Motion model: prediction of the pose, and the prior that it gives."""

import numpy as np
from numpy.typing import NDArray
from plane_world import CAMERA, camera_path, render, room, slam_config, track

from cohdc_train.slam.config import MotionModelConfig
from cohdc_train.slam.geometry.se3 import exp_se3, inverse, log_se3, to_local
from cohdc_train.slam.optimization.pose import optimize_pose, pose_information
from cohdc_train.slam.optimization.reprojection import Observations, Prior, ReprojectionModel
from cohdc_train.slam.system import Slam
from cohdc_train.slam.tracking.motion_model import MotionModel, Prediction
from cohdc_train.trajectory.evaluate import score
from cohdc_train.trajectory.trajectory import Trajectory

CONFIG = MotionModelConfig()
ACCELERATION = np.repeat(CONFIG.acceleration_sigma, 3)
SURE = 1e12 * np.eye(6)
VELOCITY = np.array([0.3, -0.2, 0.1, 0.2, 0.4, -0.3])  # m/s, rad/s
STEP = 1 / 30


def at(t: float) -> NDArray[np.float64]:
    """T_cw at t of a camera that keeps its velocity."""
    return exp_se3(VELOCITY * t)


def predict(motion: MotionModel, t: float) -> Prediction:
    """The prediction of a model that has one."""
    prediction = motion.predict(t)
    assert prediction is not None
    return prediction


def moved(times: list[float]) -> MotionModel:
    motion = MotionModel()
    for t in times:
        motion.update(t, at(t), SURE)
    return motion


def test_a_steady_motion_goes_on_over_uneven_steps() -> None:
    times = [0.0, 0.03, 0.07, 0.1, 0.13, 0.2, 0.23, 0.27, 0.3, 0.33, 0.37]
    motion = moved(times)
    assert motion.twist is not None
    np.testing.assert_allclose(motion.twist, VELOCITY, atol=2e-3)
    np.testing.assert_allclose(predict(motion, 0.47).prior.T_cw, at(0.47), atol=3e-4)


def test_after_a_long_pause_the_camera_is_not_held_to_have_gone_on_for_ever() -> None:
    motion = moved([k * STEP for k in range(12)])
    last = 11 * STEP
    far, farther = predict(motion, last + 2.0).prior, predict(motion, last + 4.0).prior
    np.testing.assert_allclose(far.T_cw, at(last + 0.2), atol=2e-3)
    np.testing.assert_allclose(farther.T_cw, far.T_cw)
    assert np.all(np.diag(farther.information) < np.diag(far.information))


def test_nothing_is_known_before_two_frames_nor_after_a_loss() -> None:
    motion = MotionModel()
    assert motion.twist is None
    motion.update(0.0, np.eye(4), SURE)
    assert motion.twist is None
    np.testing.assert_allclose(predict(motion, STEP).prior.T_cw, np.eye(4))
    motion.update(STEP, at(STEP), SURE)
    assert motion.twist is not None
    motion.reset()
    assert motion.twist is None


def test_the_motion_goes_along_when_the_map_moves() -> None:
    motion, shift = (
        moved([k * STEP for k in range(12)]),
        exp_se3(np.array([0.5, 0.1, -0.3, 0.2, -0.4, 0.3])),
    )
    before = predict(motion, 12 * STEP).prior
    motion.correct(shift)
    after = predict(motion, 12 * STEP).prior
    np.testing.assert_allclose(after.T_cw, before.T_cw @ shift, atol=1e-12)
    np.testing.assert_allclose(after.information, before.information)


def test_a_leap_is_believed_and_the_velocity_is_then_unknown_again() -> None:
    motion = moved([k * STEP for k in range(12)])
    sure = np.diag(predict(motion, 12 * STEP).prior.information)
    motion.update(12 * STEP, exp_se3(np.array([0.3, 0, 0, 0, 0, 0])) @ at(12 * STEP), SURE)
    assert motion.twist is None
    unsure = predict(motion, 13 * STEP).prior
    assert np.all(np.diag(unsure.information) < sure / 20)
    np.testing.assert_allclose(unsure.T_cw, exp_se3(np.array([0.3, 0, 0, 0, 0, 0])) @ at(12 * STEP))


def test_a_start_that_a_hand_can_make_gives_a_velocity_at_once() -> None:
    motion = MotionModel()
    for k in range(12):
        motion.update(k * STEP, np.eye(4), SURE)
    start = np.array([0.05, 0, 0, 0, 0, 0.04])
    motion.update(12 * STEP, exp_se3(start), SURE)
    assert motion.twist is not None
    np.testing.assert_allclose(motion.twist, start / STEP, atol=0.02)


def test_two_frames_of_one_stamp_leave_all_numbers_finite() -> None:
    motion = moved([k * STEP for k in range(12)])
    for leap in (0.0, 0.3):
        motion.update(11 * STEP, exp_se3(np.array([leap, 0, 0, 0, 0, 0])) @ at(11 * STEP), SURE)
        assert motion.twist is None
        assert np.isfinite(predict(motion, 11 * STEP).prior.information).all()
        np.testing.assert_allclose(
            predict(motion, 12 * STEP).prior.T_cw[:3, 3], motion._state.T_cw[:3, 3], atol=0.03
        )


def test_a_clock_that_leaps_breaks_nothing() -> None:
    for leap in (1e7, -1e4):
        motion = moved([k * STEP for k in range(12)])
        for k in range(4):
            expected = predict(motion, 11 * STEP + leap + k * STEP).prior
            assert np.linalg.eigvalsh(expected.information).min() > 0
            np.testing.assert_allclose(expected.T_cw[:3, 3], at(11 * STEP)[:3, 3], atol=0.3)
            motion.update(11 * STEP + leap + k * STEP, at(11 * STEP), SURE)


def test_a_shaken_camera_is_not_held_to_what_was_expected() -> None:
    """A steady one is, in frames that see little; and one that was shaken, again half a second
    after a leap.
    """
    motion = moved([k * STEP for k in range(12)])
    assert predict(motion, 12 * STEP).prior_for(100) is not None
    assert predict(motion, 12 * STEP).prior_for(1000) is None
    for k in range(12, 20):
        motion.update(
            k * STEP, exp_se3(np.array([0.01 * (-1) ** k, 0, 0, 0, 0, 0])) @ at(k * STEP), SURE
        )
    assert predict(motion, 20 * STEP).prior_for(100) is None
    motion.update(20 * STEP, exp_se3(np.array([2.0, 0, 0, 0, 0, 0])) @ at(20 * STEP), SURE)
    for k in range(21, 36):
        motion.update(k * STEP, at(k * STEP), SURE)
    assert predict(motion, 36 * STEP).prior_for(100) is not None


def test_errors_are_as_large_as_foreseen() -> None:
    """Cameras shoved at random, seen with noise: squared distances in sigmas from what was expected
    average 6.
    """
    rng, squares = np.random.default_rng(0), []
    for _ in range(40):
        motion, T_cw, velocity = MotionModel(), np.eye(4), rng.normal(0, 0.3, 6)
        for k in range(30):
            if k > 5:
                off = log_se3(T_cw @ inverse(predict(motion, k * STEP).prior.T_cw))
                squares.append(off @ predict(motion, k * STEP).prior.information @ off)
            motion.update(
                k * STEP, exp_se3(rng.normal(0, np.full(6, CONFIG.pose_noise_floor))) @ T_cw, SURE
            )
            push = rng.normal(0, ACCELERATION)
            T_cw = exp_se3(velocity * STEP + push * STEP**2 / 2) @ T_cw
            velocity = velocity + push * STEP
    assert 5.5 < np.mean(squares) < 6.5, np.mean(squares)


def world(count: int, spread: float) -> tuple[NDArray[np.float64], Observations]:
    """Points 2 to 3 m before a camera at the origin, all within `spread` px of each other, measured
    with 1 px.
    """
    rng = np.random.default_rng(1)
    pixels = np.array([40.0, 40.0]) + rng.uniform(0, spread, (count, 2))
    depths = rng.uniform(2, 3, count)
    points = CAMERA.backproject(pixels, depths)
    noisy = pixels + rng.normal(0, 1, pixels.shape)
    return points, Observations(
        noisy, depths * (1 + rng.normal(0, 0.02, count)), np.ones(count), np.ones(count)
    )


def test_an_expectation_decides_where_little_is_seen_and_only_there() -> None:
    expected = Prior(np.eye(4), np.diag(np.repeat([0.002, 0.002], 3) ** -2.0))
    errors = {}
    for count, spread in ((20, 30.0), (2000, 200.0)):
        points, seen = world(count, spread)
        alone, _ = optimize_pose(np.eye(4), points, seen, ReprojectionModel(CAMERA))
        both, _ = optimize_pose(np.eye(4), points, seen, ReprojectionModel(CAMERA), prior=expected)
        errors[count] = np.linalg.norm(alone[:3, 3]), np.linalg.norm(both[:3, 3])
    assert errors[20][0] > 0.01
    assert errors[20][1] < 0.2 * errors[20][0]
    elsewhere = Prior(exp_se3(np.array([0.01, 0, 0, 0, 0, 0])), expected.information)
    points, seen = world(2000, 200.0)
    pulled, _ = optimize_pose(np.eye(4), points, seen, ReprojectionModel(CAMERA), prior=elsewhere)
    assert np.linalg.norm(pulled[:3, 3]) < 0.004, (
        "what is seen outweighs an expectation that lies 1 cm off"
    )


def test_the_pull_is_the_gradient_of_the_squared_distance() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6))
    prior = Prior(exp_se3(rng.normal(0, 1, 6)), root @ root.T)
    T_cw = exp_se3(rng.normal(0, 0.003, 6)) @ prior.T_cw

    def half_square(xi: NDArray[np.float64]) -> float:
        off = log_se3(exp_se3(xi) @ T_cw @ inverse(prior.T_cw))
        return float(off @ prior.information @ off) / 2

    step = 1e-6
    numeric = [(half_square(step * e) - half_square(-step * e)) / (2 * step) for e in np.eye(6)]
    np.testing.assert_allclose(
        prior.gradient(T_cw), numeric, rtol=0.01, atol=0.01 * np.abs(numeric).max()
    )


def test_information_says_how_poses_scatter() -> None:
    points, _ = world(60, 100.0)
    rng, true = np.random.default_rng(3), ReprojectionModel(CAMERA)
    local = to_local(np.eye(4), points)
    pixels, depths = CAMERA.project(local), local[:, 2]
    steps = []
    for _ in range(300):
        disparity = true.bf / depths + rng.normal(0, 1, 60)
        seen = Observations(
            pixels + rng.normal(0, 1, (60, 2)), true.bf / disparity, np.ones(60), np.ones(60)
        )
        steps.append(log_se3(optimize_pose(np.eye(4), points, seen, true)[0]))
    exact = Observations(pixels, depths, np.ones(60), np.ones(60))
    foreseen = np.sqrt(np.diag(np.linalg.inv(pose_information(np.eye(4), points, exact, true))))
    np.testing.assert_allclose(np.std(steps, axis=0), foreseen, rtol=0.2)


def test_a_frame_that_sees_a_part_of_the_room_does_not_jump() -> None:
    path = np.concatenate([camera_path(1, later=k / 4) for k in range(60)])  # a calm hand: .2 m/s^2
    views = [render(room(), T_wc) for T_wc in path]
    almost_all = np.ones((240, 320), dtype=np.bool_)
    almost_all[150:, 230:] = False
    errors = {}
    for few in (0, CONFIG.prior_below_points):
        config = slam_config(
            120,
            smoothing__enabled=False,
            refinement__enabled=False,
            motion__prior_below_points=few,
        )
        slam = Slam(CAMERA, config)
        poses = [
            track(slam, rgb, depth, k / 30, almost_all if k >= 10 else None)
            for k, (rgb, depth, _) in enumerate(views)
        ]
        assert all(0 < pose.num_matches < 150 for pose in poses[10:]), [
            p.inliers for p in poses[10:]
        ]
        way = slam.trajectory()
        errors[few] = score(Trajectory(np.arange(len(path)) / 30, path), way)["ate_m"]["rmse"]
    assert errors[CONFIG.prior_below_points] < 0.7 * errors[0], errors
