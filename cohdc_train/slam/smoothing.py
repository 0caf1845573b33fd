"""A trajectory after the fact: where each frame was by what it saw, what those around it saw, and how a hand moves.

The fixed-interval counterpart of `motion`: velocity changes as there, unless it is seen to change faster, but frames
that come later count as well. All poses are found at once.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.ndimage import uniform_filter1d

from cohdc_train.slam.motion import ACCELERATION, LONGEST, SHORTEST
from cohdc_train.slam.optimization import Array, exp_se3, inverse, log_se3

_SHARED = 2e-3  # m and rad: error of a frame that its information does not know of
_LEAST = 1.0  # 1/m^2 and 1/rad^2: information of a frame that saw nothing
_AROUND = 15  # frames on either side, over which the camera is held to be as calm or as shaken
_ROUNDS = 3  # of finding out how shaken it is
_BAND = 18  # diagonals of the normal equations: three frames hang together


def smoothed(stamps: Array, poses: Array, information: Array, pulls: Array) -> Array:
    """stamps: [n] s, rising; poses: [n, 4, 4] T_cw world to camera, m; information: [n, 6, 6] inverse covariance of
    each by what it saw, in the camera's frame, (m, rad); pulls: [n, 6] `Prior.pull` of what was expected when the pose
    was found, 0 where nothing was: it is taken out, for what came before counts here anyway. Returns [n, 4, 4] T_cw.

    Frames further apart than LONGEST have nothing to do with each other.
    """
    if len(stamps) < 3:
        return poses
    step = np.diff(stamps)
    near = (step > SHORTEST) & (step <= LONGEST)
    middle = np.flatnonzero(near[:-1] & near[1:]) + 1
    before, after = step[middle - 1], step[middle]
    shares = np.stack([1 / before, -1 / before - 1 / after, 1 / after])
    deviation = ACCELERATION * ((before + after) / 2)[:, None]
    certain, axes = np.linalg.eigh(information)
    certain = np.maximum(certain, _LEAST)
    shared = 1 / (1 + certain * _SHARED**2)
    seen = (axes * (certain * shared)[:, None]) @ axes.transpose(0, 2, 1)
    towards = np.einsum("nab,nb,ncb,nc->na", axes, shared, axes, pulls)
    motions = log_se3(poses[1:] @ inverse(poses[:-1]))
    change = motions[middle] / after[:, None] - motions[middle - 1] / before[:, None]
    gaps = np.flatnonzero(np.diff(middle) > 1) + 1
    weight = np.ones((len(middle), 6))
    small = np.zeros((len(stamps), 6))
    for _ in range(_ROUNDS if len(middle) else 0):
        small = _solved(seen, towards, middle, shares, change, weight / deviation**2)
        around = np.stack([small[middle - 1], small[middle], small[middle + 1]])
        left = (change + np.einsum("km,kma->ma", shares, around)) / deviation
        weight = 1 / np.maximum(1.0, np.concatenate([_around(run) for run in np.split(left**2, gaps)]))
    return np.asarray(exp_se3(small) @ poses, dtype=np.float64)


def _around(squares: Array) -> Array:
    """squares: [k, 6] of frames in a row. Returns [k, 6], their mean over the frames around each."""
    return np.asarray(uniform_filter1d(squares, 2 * _AROUND + 1, axis=0, mode="nearest"))


def _solved(
    seen: Array, towards: Array, middle: NDArray[np.int64], shares: Array, change: Array, weight: Array
) -> Array:
    """[n, 6] the small motions that reconcile frames with changes of velocity [m, 6] at the middle ones.

    seen: [n, 6, 6] information; towards: [n, 6] the same times the small motion to where what a frame saw puts it;
    shares: [3, m] of the motions of the frame before, the middle one and the one after in a change; weight: [m, 6].
    """
    n = len(seen)
    diagonal, right = np.zeros((3, n, 6)), towards.copy()  # by how many frames a block lies below the diagonal
    for row in range(3):
        np.add.at(right, middle + row - 1, -shares[row][:, None] * weight * change)
        for column in range(row + 1):
            product = (shares[row] * shares[column])[:, None] * weight
            np.add.at(diagonal[row - column], middle + column - 1, product)
    band = np.zeros((_BAND, 6 * n))
    for offset in range(6):
        for a in range(offset, 6):
            band[offset, a - offset :: 6] = seen[:, a, a - offset]
    for frames in range(3):
        for a in range(6):
            band[6 * frames, a::6] += diagonal[frames, :, a]
    return np.asarray(solveh_banded(band, right.ravel(), lower=True)).reshape(n, 6)
