"""How the camera moves: a Kalman filter of constant velocity. It says where the next frame should
be, and how surely.

A hand speeds up by .2 to .6 m/s^2 and 2 to 6 rad/s^2 per axis (RMS at 30 frames/s of TUM's seven
motion-captured sequences), so that what a frame sees decides where it is, but one that sees only a
corner of the room cannot leap.
"""

from dataclasses import dataclass

import numpy as np

from cohdc_train.slam.config import ACCELERATION, FEW, LONGEST, SHORTEST
from cohdc_train.slam.geometry.se3 import Array, exp_se3, inverse, log_se3
from cohdc_train.slam.optimization.reprojection import Prior

_UNKNOWN = np.repeat([1.0, 2.0], 3)  # m/s and rad/s: of a velocity of which nothing is known
_EXACT = np.full(6, 1e-4)  # m and rad: no pose is known better, however many points say so
_PAUSE = 10.0  # s, after which nothing more is forgotten
_LEARNT = 0.2  # share of the latest frame in how calmly the camera is held to move
_NOTHING = np.zeros(6)
_SURPRISE = 100.0  # squared standard deviations of a pose, from which on it is a leap


@dataclass(frozen=True)
class Prediction:
    """Where a frame should be. calm: of late the camera has moved as foreseen."""

    prior: Prior
    calm: bool

    def given(self, points: int) -> Prior | None:
        """What counts beside so many points that a frame sees: nothing where they suffice, or the
        camera is shaken.
        """
        return self.prior if self.calm and points < FEW else None


class MotionModel:
    """Pose and velocity of the latest frame with their joint covariance [12, 12], of (m, rad, m/s,
    rad/s).

    Errors are those of a small motion in the camera's frame: T_true = exp(error) T.
    """

    def __init__(self) -> None:
        self._t: float | None = None
        self._step = 0.0  # s between the latest two frames
        self._T_cw = np.eye(4)
        self._velocity = np.zeros(6)
        self._covariance = np.zeros((12, 12))
        self._unrest = 0.0  # squared surprise of late, as a share of the foreseen one

    def forget(self) -> None:
        """The place is lost: nothing is known."""
        self._t = None

    def carry(self, motion: Array) -> None:
        """The map has moved, and the latest pose with it: T_cw becomes T_cw @ motion."""
        self._T_cw = self._T_cw @ motion

    @property
    def twist(self) -> Array | None:
        """[6] velocity, (m/s, rad/s): T_cw(t + dt) = exp(twist dt) T_cw(t). None while it is not
        known.
        """
        return self._velocity if self._t is not None and 0 < self._step <= LONGEST else None

    def expected(self, t: float) -> Prediction:
        """Where the camera is at t, s, later than the latest frame.

        After a pause it is held to have gone on for as long as its velocity is known to say
        something.
        """
        return Prediction(self._prior(t, self._predicted(t)), self._unrest < 1)

    def found(self, t: float, T_cw: Array, information: Array, pull: Array = _NOTHING) -> None:
        """The frame at t is at T_cw. information: [6, 6] of what it saw; pull: [6] `Prior.pull` of
        what was expected, where T_cw is a compromise with that."""
        seen = np.asarray(
            np.linalg.inv(information + 1e-6 * np.eye(6)) + np.diag(_EXACT**2), dtype=np.float64
        )
        if self._t is None:
            self._begin(T_cw, seen)
            self._unrest = 0.0
        else:
            self._update(t, T_cw, seen, pull)
        self._t = t

    def _begin(self, T_cw: Array, seen: Array, velocity: Array | None = None) -> None:
        """At a pose, known by the covariance [6, 6] of what was seen, with a velocity of which
        little is known.
        """
        self._T_cw = T_cw
        if velocity is None:
            self._step = 0.0
        self._velocity = np.zeros(6) if velocity is None else velocity
        self._covariance = np.diag(np.concatenate([np.zeros(6), _UNKNOWN**2]))
        self._covariance[:6, :6] = seen

    def _update(self, t: float, T_cw: Array, seen: Array, pull: Array) -> None:
        assert self._t is not None
        covariance = self._predicted(t)
        expected = self._prior(t, covariance)
        self._step = t - self._t
        off = log_se3(T_cw @ inverse(expected.T_cw))
        spread = covariance[:6, :6] + seen
        off = off + seen @ pull  # by how much it was before the compromise
        inverted = np.linalg.inv(spread)
        surprise = float(off @ inverted @ off)
        self._unrest += _LEARNT * (min(surprise, _SURPRISE) / 6 - self._unrest)
        if surprise > _SURPRISE:
            velocity = log_se3(T_cw @ inverse(self._T_cw)) / max(self._step, SHORTEST)
            self._begin(T_cw, seen, velocity if np.all(np.abs(velocity) < 3 * _UNKNOWN) else None)
            return
        gain = covariance[:, :6] @ inverted
        correction = gain @ off
        self._T_cw = exp_se3(correction[:6]) @ expected.T_cw
        self._velocity = self._velocity + correction[6:]
        self._covariance = covariance - gain @ spread @ gain.T

    def _prior(self, t: float, predicted: Array) -> Prior:
        """The pose at t and how surely, of the covariance [12, 12] predicted for then."""
        information = np.asarray(np.linalg.inv(predicted[:6, :6]), dtype=np.float64)
        return Prior(exp_se3(self._ahead(t) * self._velocity) @ self._T_cw, information)

    def _ahead(self, t: float) -> float:
        """s for which the velocity is held."""
        assert self._t is not None
        return min(max(t - self._t, 0.0), max(self._step, LONGEST))

    def _predicted(self, t: float) -> Array:
        """[12, 12] covariance at t, before anything is seen."""
        assert self._t is not None
        dt, identity = min(max(t - self._t, 0.0), _PAUSE), np.eye(6)
        step = np.block([[identity, dt * identity], [np.zeros((6, 6)), identity]])
        noise = np.concatenate([dt * dt / 2 * np.diag(ACCELERATION), dt * np.diag(ACCELERATION)])
        return np.asarray(step @ self._covariance @ step.T + noise @ noise.T)
