"""A trajectory after the fact: where each frame was by what it saw, what those around it saw, and
how a hand moves.

The fixed-interval counterpart of `motion`: velocity changes as there, unless it is seen to change
faster, but frames that come later count as well. All poses are found at once.
"""

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import uniform_filter1d

from cohdc_train.slam.config import ACCELERATION, LONGEST, SHORTEST
from cohdc_train.slam.geometry.se3 import Array, exp_se3, inverse, log_se3

_SHARED = 2e-3  # m and rad: error of a frame that its information does not know of
_LEAST = 1.0  # 1/m^2 and 1/rad^2: information of a frame that saw nothing
_LEAST_SHARE = 0.01  # of the variance that frames claim, which is left to them at least
_AROUND = 15  # frames on either side, over which the camera is held to be as calm or as shaken
_ROUNDS = 3  # of finding out how shaken it is
_BAND = 18  # diagonals of the normal equations: three frames hang together


def smoothed(stamps: Array, poses: Array, information: Array, pulls: Array) -> Array:
    """stamps: [n] s, rising; poses: [n, 4, 4] T_cw world to camera, m; information: [n, 6, 6]
    inverse covariance of each by what it saw, in the camera's frame, (m, rad); pulls: [n, 6]
    `Prior.pull` of what was expected when the pose was found, 0 where nothing was: it is taken out,
    for what came before counts here anyway. Returns [n, 4, 4] T_cw.

    Frames further apart than LONGEST have nothing to do with each other.
    """
    step = np.diff(stamps)
    ends = np.flatnonzero((step <= SHORTEST) | (step > LONGEST)) + 1
    runs = [np.split(values, ends) for values in (stamps, poses, information, pulls)]
    return np.concatenate([_smoothed_run(*run) for run in zip(*runs, strict=True)])


def _smoothed_run(stamps: Array, poses: Array, information: Array, pulls: Array) -> Array:
    """The same of frames that follow closely upon each other."""
    if len(stamps) < 3:
        return poses
    before, after = np.diff(stamps)[:-1], np.diff(stamps)[1:]
    shares = np.stack([1 / before, -1 / before - 1 / after, 1 / after])[..., None]
    deviation = ACCELERATION * ((before + after) / 2)[:, None]
    motions = log_se3(poses[1:] @ inverse(poses[:-1]))
    change = motions[1:] / after[:, None] - motions[:-1] / before[:, None]
    certain, axes = np.linalg.eigh(information)
    certain = np.maximum(certain, _LEAST)
    away = np.einsum("nab,nb,ncb,nc->na", axes, 1 / certain, axes, pulls)
    seen = (axes * (certain / (1 + certain * _SHARED**2))[:, None]) @ axes.transpose(0, 2, 1)
    seen = seen * _sharper(seen, shares, change, deviation)
    towards = np.einsum("nab,nb->na", seen, away)
    weight, small = np.ones_like(change), np.zeros((len(stamps), 6))
    for _ in range(_ROUNDS):
        small = _solved(seen, towards, shares, change, weight / deviation**2)
        left = (change + (shares * np.stack(_threes(small))).sum(axis=0)) / deviation
        weight = 1 / np.maximum(
            1.0, uniform_filter1d(left**2, 2 * _AROUND + 1, axis=0, mode="nearest")
        )
    return np.asarray(exp_se3(small) @ poses, dtype=np.float64)


def _threes(values: Array) -> tuple[Array, Array, Array]:
    """values: [n, ...] of frames. Those of the frame before, of the frame and of the one after, [n
    - 2, ...] each.
    """
    return values[:-2], values[1:-1], values[2:]


def _sharper(seen: Array, shares: Array, change: Array, deviation: Array) -> Array:
    """[6, 6] how much more frames know than they say: with so much noise velocity would change more
    than it does.
    """
    own = np.diagonal(np.linalg.inv(seen), axis1=1, axis2=2)
    foreseen = (shares**2 * np.stack(_threes(own))).sum(axis=0).mean(axis=0)
    share = np.clip(
        ((change**2).mean(axis=0) - (deviation**2).mean(axis=0)) / foreseen, _LEAST_SHARE, 1.0
    )
    return np.asarray(1 / np.sqrt(share[:, None] * share[None]))


def _solved(seen: Array, towards: Array, shares: Array, change: Array, weight: Array) -> Array:
    """[n, 6] the small motions that reconcile frames with changes of velocity [n - 2, 6].

    seen: [n, 6, 6] information; towards: [n, 6] the same times the small motion to where what a
    frame saw puts it;
    shares: [3, n - 2, 1] of the motions of three frames in a change; weight: [n - 2, 6].
    """
    n = len(seen)
    diagonal, right = (
        np.zeros((3, n, 6)),
        towards.copy(),
    )  # by how many frames a block lies below the diagonal
    for row in range(3):
        _threes(right)[row][...] -= shares[row] * weight * change
        for column in range(row + 1):
            _threes(diagonal[row - column])[column][...] += shares[row] * shares[column] * weight
    band = np.zeros((_BAND, 6 * n))
    for offset in range(6):
        for a in range(offset, 6):
            band[offset, a - offset :: 6] = seen[:, a, a - offset]
    for frames in range(3):
        for a in range(6):
            band[6 * frames, a::6] += diagonal[frames, :, a]
    return np.asarray(solveh_banded(band, right.ravel(), lower=True)).reshape(n, 6)
