"""Motion model: predicted pose, and the prior that it provides."""

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
CERTAIN = 1e12 * np.eye(6)
VELOCITY = np.array([0.3, -0.2, 0.1, 0.2, 0.4, -0.3])  # m/s, rad/s
STEP = 1 / 30


def at(t: float) -> NDArray[np.float64]:
    """Return T_cw at time t of a camera with constant velocity."""
    return exp_se3(VELOCITY * t)


def predict(motion: MotionModel, t: float) -> Prediction:
    """Return the prediction of a model that is initialized."""
    prediction = motion.predict(t)
    assert prediction is not None
    return prediction


def moved(times: list[float]) -> MotionModel:
    motion = MotionModel()
    for t in times:
        motion.update(t, at(t), CERTAIN)
    return motion


def test_constant_velocity_is_predicted_over_uneven_steps() -> None:
    times = [0.0, 0.03, 0.07, 0.1, 0.13, 0.2, 0.23, 0.27, 0.3, 0.33, 0.37]
    motion = moved(times)
    assert motion.twist is not None
    np.testing.assert_allclose(motion.twist, VELOCITY, atol=2e-3)
    np.testing.assert_allclose(predict(motion, 0.47).prior.T_cw, at(0.47), atol=3e-4)


def test_prediction_stops_after_longest_gap() -> None:
    motion = moved([k * STEP for k in range(12)])
    last = 11 * STEP
    far, farther = predict(motion, last + 2.0).prior, predict(motion, last + 4.0).prior
    np.testing.assert_allclose(far.T_cw, at(last + 0.2), atol=2e-3)
    np.testing.assert_allclose(farther.T_cw, far.T_cw)
    assert np.all(np.diag(farther.information) < np.diag(far.information))


def test_velocity_is_unknown_before_two_frames_and_after_reset() -> None:
    motion = MotionModel()
    assert motion.twist is None
    motion.update(0.0, np.eye(4), CERTAIN)
    assert motion.twist is None
    np.testing.assert_allclose(predict(motion, STEP).prior.T_cw, np.eye(4))
    motion.update(STEP, at(STEP), CERTAIN)
    assert motion.twist is not None
    motion.reset()
    assert motion.twist is None


def test_prediction_moves_with_map() -> None:
    motion, shift = (
        moved([k * STEP for k in range(12)]),
        exp_se3(np.array([0.5, 0.1, -0.3, 0.2, -0.4, 0.3])),
    )
    before = predict(motion, 12 * STEP).prior
    motion.correct(shift)
    after = predict(motion, 12 * STEP).prior
    np.testing.assert_allclose(after.T_cw, before.T_cw @ shift, atol=1e-12)
    np.testing.assert_allclose(after.information, before.information)


def test_jump_is_accepted_and_velocity_becomes_unknown() -> None:
    motion = moved([k * STEP for k in range(12)])
    information_before = np.diag(predict(motion, 12 * STEP).prior.information)
    motion.update(12 * STEP, exp_se3(np.array([0.3, 0, 0, 0, 0, 0])) @ at(12 * STEP), CERTAIN)
    assert motion.twist is None
    after_jump = predict(motion, 13 * STEP).prior
    assert np.all(np.diag(after_jump.information) < information_before / 20)
    np.testing.assert_allclose(
        after_jump.T_cw, exp_se3(np.array([0.3, 0, 0, 0, 0, 0])) @ at(12 * STEP)
    )


def test_plausible_start_gives_velocity_after_one_step() -> None:
    motion = MotionModel()
    for k in range(12):
        motion.update(k * STEP, np.eye(4), CERTAIN)
    start = np.array([0.05, 0, 0, 0, 0, 0.04])
    motion.update(12 * STEP, exp_se3(start), CERTAIN)
    assert motion.twist is not None
    np.testing.assert_allclose(motion.twist, start / STEP, atol=0.02)


def test_equal_timestamps_give_finite_prediction() -> None:
    motion = moved([k * STEP for k in range(12)])
    for jump in (0.0, 0.3):
        motion.update(11 * STEP, exp_se3(np.array([jump, 0, 0, 0, 0, 0])) @ at(11 * STEP), CERTAIN)
        assert motion.twist is None
        assert np.isfinite(predict(motion, 11 * STEP).prior.information).all()
        np.testing.assert_allclose(
            predict(motion, 12 * STEP).prior.T_cw[:3, 3], motion._state.T_cw[:3, 3], atol=0.03
        )


def test_jump_of_timestamps_gives_finite_prediction() -> None:
    for jump in (1e7, -1e4):
        motion = moved([k * STEP for k in range(12)])
        for k in range(4):
            expected = predict(motion, 11 * STEP + jump + k * STEP).prior
            assert np.linalg.eigvalsh(expected.information).min() > 0
            np.testing.assert_allclose(expected.T_cw[:3, 3], at(11 * STEP)[:3, 3], atol=0.3)
            motion.update(11 * STEP + jump + k * STEP, at(11 * STEP), CERTAIN)


def test_prior_is_disabled_for_shaken_camera() -> None:
    """The prior counts for a steady camera with few points, and half a second after a jump."""
    motion = moved([k * STEP for k in range(12)])
    assert predict(motion, 12 * STEP).prior_for(100) is not None
    assert predict(motion, 12 * STEP).prior_for(1000) is None
    for k in range(12, 20):
        motion.update(
            k * STEP, exp_se3(np.array([0.01 * (-1) ** k, 0, 0, 0, 0, 0])) @ at(k * STEP), CERTAIN
        )
    assert predict(motion, 20 * STEP).prior_for(100) is None
    motion.update(20 * STEP, exp_se3(np.array([2.0, 0, 0, 0, 0, 0])) @ at(20 * STEP), CERTAIN)
    for k in range(21, 36):
        motion.update(k * STEP, at(k * STEP), CERTAIN)
    assert predict(motion, 36 * STEP).prior_for(100) is not None


def test_prediction_errors_match_covariance() -> None:
    """The squared Mahalanobis distance of randomly accelerated cameras averages 6."""
    rng, squares = np.random.default_rng(0), []
    for _ in range(40):
        motion, T_cw, velocity = MotionModel(), np.eye(4), rng.normal(0, 0.3, 6)
        for k in range(30):
            if k > 5:
                error = log_se3(T_cw @ inverse(predict(motion, k * STEP).prior.T_cw))
                squares.append(error @ predict(motion, k * STEP).prior.information @ error)
            motion.update(
                k * STEP,
                exp_se3(rng.normal(0, np.full(6, CONFIG.pose_noise_floor))) @ T_cw,
                CERTAIN,
            )
            acceleration = rng.normal(0, ACCELERATION)
            T_cw = exp_se3(velocity * STEP + acceleration * STEP**2 / 2) @ T_cw
            velocity = velocity + acceleration * STEP
    assert 5.5 < np.mean(squares) < 6.5, np.mean(squares)


def world(count: int, spread: float) -> tuple[NDArray[np.float64], Observations]:
    """Return points 2 to 3 m in front of a camera, and measurements with a noise of 1 px.

    All points project into a square of `spread` px.
    """
    rng = np.random.default_rng(1)
    pixels = np.array([40.0, 40.0]) + rng.uniform(0, spread, (count, 2))
    depths = rng.uniform(2, 3, count)
    points = CAMERA.backproject(pixels, depths)
    noisy = pixels + rng.normal(0, 1, pixels.shape)
    return points, Observations(
        noisy, depths * (1 + rng.normal(0, 0.02, count)), np.ones(count), np.ones(count)
    )


def test_prior_decides_only_with_few_measurements() -> None:
    expected = Prior(np.eye(4), np.diag(np.repeat([0.002, 0.002], 3) ** -2.0))
    errors = {}
    for count, spread in ((20, 30.0), (2000, 200.0)):
        points, observations = world(count, spread)
        without_prior, _ = optimize_pose(np.eye(4), points, observations, ReprojectionModel(CAMERA))
        with_prior, _ = optimize_pose(
            np.eye(4), points, observations, ReprojectionModel(CAMERA), prior=expected
        )
        errors[count] = np.linalg.norm(without_prior[:3, 3]), np.linalg.norm(with_prior[:3, 3])
    assert errors[20][0] > 0.01
    assert errors[20][1] < 0.2 * errors[20][0]
    wrong_prior = Prior(exp_se3(np.array([0.01, 0, 0, 0, 0, 0])), expected.information)
    points, observations = world(2000, 200.0)
    fused, _ = optimize_pose(
        np.eye(4), points, observations, ReprojectionModel(CAMERA), prior=wrong_prior
    )
    assert np.linalg.norm(fused[:3, 3]) < 0.004, (
        "many measurements outweigh a prior that is wrong by 1 cm"
    )


def test_prior_gradient_equals_finite_differences() -> None:
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6))
    prior = Prior(exp_se3(rng.normal(0, 1, 6)), root @ root.T)
    T_cw = exp_se3(rng.normal(0, 0.003, 6)) @ prior.T_cw

    def half_square(xi: NDArray[np.float64]) -> float:
        error = log_se3(exp_se3(xi) @ T_cw @ inverse(prior.T_cw))
        return float(error @ prior.information @ error) / 2

    step = 1e-6
    numeric = [(half_square(step * e) - half_square(-step * e)) / (2 * step) for e in np.eye(6)]
    np.testing.assert_allclose(
        prior.gradient(T_cw), numeric, rtol=0.01, atol=0.01 * np.abs(numeric).max()
    )


def test_pose_information_matches_scatter_of_poses() -> None:
    points, _ = world(60, 100.0)
    rng, true = np.random.default_rng(3), ReprojectionModel(CAMERA)
    local = to_local(np.eye(4), points)
    pixels, depths = CAMERA.project(local), local[:, 2]
    steps = []
    for _ in range(300):
        disparity = true.bf / depths + rng.normal(0, 1, 60)
        observations = Observations(
            pixels + rng.normal(0, 1, (60, 2)), true.bf / disparity, np.ones(60), np.ones(60)
        )
        steps.append(log_se3(optimize_pose(np.eye(4), points, observations, true)[0]))
    exact = Observations(pixels, depths, np.ones(60), np.ones(60))
    predicted_sigma = np.sqrt(
        np.diag(np.linalg.inv(pose_information(np.eye(4), points, exact, true)))
    )
    np.testing.assert_allclose(np.std(steps, axis=0), predicted_sigma, rtol=0.2)


def test_prior_reduces_error_of_mostly_masked_frames() -> None:
    path = np.concatenate(
        [camera_path(1, later=k / 4) for k in range(60)]
    )  # a steady camera: 0.2 m/s^2
    views = [render(room(), T_wc) for T_wc in path]
    almost_all = np.ones((240, 320), dtype=np.bool_)
    almost_all[150:, 230:] = False
    errors = {}
    for prior_below_points in (0, CONFIG.prior_below_points):
        config = slam_config(
            120,
            smoothing__enabled=False,
            refinement__enabled=False,
            motion__prior_below_points=prior_below_points,
        )
        slam = Slam(CAMERA, config)
        poses = [
            track(slam, rgb, depth, k / 30, almost_all if k >= 10 else None)
            for k, (rgb, depth, _) in enumerate(views)
        ]
        assert all(0 < pose.num_matches < 150 for pose in poses[10:]), [
            p.inliers for p in poses[10:]
        ]
        trajectory = slam.trajectory()
        errors[prior_below_points] = score(Trajectory(np.arange(len(path)) / 30, path), trajectory)[
            "ate_m"
        ]["rmse"]
    assert errors[CONFIG.prior_below_points] < 0.7 * errors[0], errors
