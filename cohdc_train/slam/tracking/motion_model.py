"""Constant-velocity Kalman filter that predicts a frame's pose and its uncertainty.

The measurements of a frame determine its pose; the prediction limits jumps of frames with few
measurements.
"""

from dataclasses import dataclass, replace

import numpy as np

from cohdc_train.slam.config import MotionModelConfig
from cohdc_train.slam.geometry.se3 import Array, exp_se3, inverse, log_se3
from cohdc_train.slam.optimization.reprojection import Prior

_MAX_VELOCITY_SIGMAS = 3  # of the initial velocity; above, the velocity after a jump is unknown


@dataclass(frozen=True)
class Prediction:
    """Predicted pose of a frame.

    is_consistent: the latest frames agreed with their predictions; prior_below_points: number of
    points of a frame, below which the prior counts.
    """

    prior: Prior
    is_consistent: bool
    prior_below_points: int

    def prior_for(self, num_points: int) -> Prior | None:
        """Return the prior for a frame that observes a number of points.

        None where these suffice, or where the camera does not move as predicted.
        """
        return self.prior if self.is_consistent and num_points < self.prior_below_points else None


@dataclass(frozen=True)
class _State:
    """Pose and velocity of the latest frame.

    timestamp: s; T_cw: [4, 4] m; velocity: [6] (m/s, rad/s); covariance: [12, 12] of both, (m, rad,
    m/s, rad/s); interval_s: between the latest two frames, 0 while the velocity is unknown;
    mean_nis: mean normalized innovation squared of the latest frames, per degree of freedom.

    Errors are those of a small motion in the camera's frame: T_true = exp(error) T.
    """

    timestamp: float
    T_cw: Array
    velocity: Array
    covariance: Array
    interval_s: float
    mean_nis: float


class MotionModel:
    """Constant-velocity model of the camera motion."""

    def __init__(self, config: MotionModelConfig = MotionModelConfig()) -> None:
        self._config = config
        self._acceleration = np.repeat(config.acceleration_sigma, 3)
        self._unknown_velocity = np.repeat(config.initial_velocity_sigma, 3)
        self._state: _State | None = None

    def reset(self) -> None:
        """Forget the motion after the track is lost."""
        self._state = None

    def correct(self, motion: Array) -> None:
        """Move the latest pose with the map: T_cw becomes T_cw @ motion, [4, 4]."""
        if self._state is not None:
            self._state = replace(self._state, T_cw=self._state.T_cw @ motion)

    @property
    def twist(self) -> Array | None:
        """Return the velocity [6], (m/s, rad/s), None while unknown.

        T_cw(t + dt) = exp(twist dt) T_cw(t).
        """
        state = self._state
        if state is None or not 0 < state.interval_s <= self._config.max_gap_s:
            return None
        return state.velocity

    def predict(self, timestamp: float) -> Prediction | None:
        """Predict the pose at a timestamp, s; None before the first frame and after a reset.

        After a long gap the camera is assumed to have moved for max_gap_s only.
        """
        state = self._state
        if state is None:
            return None
        prior = self._prior(state, timestamp, self._predict_covariance(state, timestamp))
        return Prediction(prior, state.mean_nis < 1, self._config.prior_below_points)

    def update(
        self,
        timestamp: float,
        T_cw: Array,
        information: Array,
        prior_gradient: Array | None = None,
    ) -> None:
        """Update the filter with the pose of a frame.

        Args:
            timestamp: s.
            T_cw: [4, 4] world to camera, m.
            information: [6, 6] of the frame's measurements.
            prior_gradient: [6] `Prior.gradient` at the pose, where the prediction counted.
        """
        floor = np.full(6, self._config.pose_noise_floor)
        covariance = np.asarray(
            np.linalg.inv(information + 1e-6 * np.eye(6)) + np.diag(floor**2), dtype=np.float64
        )
        gradient = np.zeros(6) if prior_gradient is None else prior_gradient
        if self._state is None:
            start = np.zeros(6)
            self._state = self._restarted(timestamp, T_cw, covariance, start, 0.0, 0.0)
        else:
            self._state = self._updated(self._state, timestamp, T_cw, covariance, gradient)

    def _restarted(
        self,
        timestamp: float,
        T_cw: Array,
        measured: Array,
        velocity: Array,
        interval_s: float,
        mean_nis: float,
    ) -> _State:
        """Return the state at a pose with covariance `measured` [6, 6] and uncertain velocity."""
        covariance = np.diag(np.concatenate([np.zeros(6), self._unknown_velocity**2]))
        covariance[:6, :6] = measured
        return _State(timestamp, T_cw, velocity, covariance, interval_s, mean_nis)

    def _updated(
        self, state: _State, timestamp: float, T_cw: Array, measured: Array, gradient: Array
    ) -> _State:
        """Return the state updated by a measured pose with covariance [6, 6]."""
        config = self._config
        covariance = self._predict_covariance(state, timestamp)
        prior = self._prior(state, timestamp, covariance)
        interval_s = timestamp - state.timestamp

        # The innovation of the measurement alone, before its fusion with the prior.
        innovation = log_se3(T_cw @ inverse(prior.T_cw)) + measured @ gradient
        innovation_covariance = covariance[:6, :6] + measured
        inverted = np.linalg.inv(innovation_covariance)
        nis = float(innovation @ inverted @ innovation)
        change = min(nis, config.max_nis) / 6 - state.mean_nis
        mean_nis = state.mean_nis + config.nis_smoothing * change

        if nis > config.max_nis:  # a jump: accept the pose, and restart the filter
            velocity = log_se3(T_cw @ inverse(state.T_cw)) / max(interval_s, config.min_gap_s)
            limit = _MAX_VELOCITY_SIGMAS * self._unknown_velocity
            if not np.all(np.abs(velocity) < limit):
                velocity, interval_s = np.zeros(6), 0.0
            return self._restarted(timestamp, T_cw, measured, velocity, interval_s, mean_nis)

        gain = covariance[:, :6] @ inverted
        correction = gain @ innovation
        return _State(
            timestamp,
            exp_se3(correction[:6]) @ prior.T_cw,
            state.velocity + correction[6:],
            covariance - gain @ innovation_covariance @ gain.T,
            interval_s,
            mean_nis,
        )

    def _prior(self, state: _State, timestamp: float, covariance: Array) -> Prior:
        """Return the predicted pose with its information; covariance: [12, 12] predicted."""
        information = np.asarray(np.linalg.inv(covariance[:6, :6]), dtype=np.float64)
        longest = max(state.interval_s, self._config.max_gap_s)
        ahead_s = min(max(timestamp - state.timestamp, 0.0), longest)
        return Prior(exp_se3(ahead_s * state.velocity) @ state.T_cw, information)

    def _predict_covariance(self, state: _State, timestamp: float) -> Array:
        """Return the predicted covariance [12, 12] at a timestamp, before the update."""
        dt = min(max(timestamp - state.timestamp, 0.0), self._config.max_prediction_s)
        identity = np.eye(6)
        step = np.block([[identity, dt * identity], [np.zeros((6, 6)), identity]])
        acceleration = np.diag(self._acceleration)
        noise = np.concatenate([dt * dt / 2 * acceleration, dt * acceleration])
        return np.asarray(step @ state.covariance @ step.T + noise @ noise.T)
