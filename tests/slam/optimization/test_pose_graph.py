"""The pose graph on round trips whose every pose is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import logm

from cohdc_train.slam.config import LoopConfig
from cohdc_train.slam.geometry.se3 import exp_se3, inverse, log_se3
from cohdc_train.slam.optimization.pose_graph import (
    Edges,
    edge_errors,
    edge_jacobians,
    optimize_graph,
)

Array = NDArray[np.float64]
SIGMA = np.array([0.01, 0.003])  # m, rad of every edge


def noisy(T: Array, rng: np.random.Generator) -> Array:
    return exp_se3(rng.normal(size=(len(T), 6)) * np.repeat(SIGMA, 3)) @ T


def square(per_side: int = 12, laps: int = 2, step: float = 0.5) -> Array:
    """Return poses [n, 4, 4] T_cw of a camera that moves around a square.

    It turns by 90 degrees along each side.
    """
    motion = exp_se3(np.array([0.0, 0.0, -step, 0.0, -np.pi / 2 / per_side, 0.0]))
    poses = [np.eye(4)]
    for _ in range(4 * per_side * laps - 1):
        poses.append(motion @ poses[-1])
    return np.stack(poses)


def graph(
    truth: Array, rng: np.random.Generator, loops: list[tuple[int, int]]
) -> tuple[Array, Edges]:
    """Return poses that drifted along noisy odometry, and the edges of odometry and loops."""
    first = np.r_[np.arange(len(truth) - 1), [a for a, _ in loops]].astype(np.int64)
    second = np.r_[np.arange(1, len(truth)), [b for _, b in loops]].astype(np.int64)
    T = noisy(truth[second] @ inverse(truth[first]), rng)
    drifted = [truth[0]]
    for motion in T[: len(truth) - 1]:
        drifted.append(motion @ drifted[-1])
    edges = Edges(
        first, second, T, np.tile(SIGMA, (len(T), 1)), np.arange(len(T)) >= len(truth) - 1
    )
    return np.stack(drifted), edges


def error(poses: Array, truth: Array) -> float:
    """RMSE of the positions, m."""
    off = inverse(poses)[:, :3, 3] - inverse(truth)[:, :3, 3]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def rounds(n: int, every: int = 6) -> list[tuple[int, int]]:
    """Return loops that connect the second lap with the first."""
    return [(k, k + n // 2) for k in range(0, n // 2, every)]


@given(st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
def test_logarithm_undoes_the_exponential_map(values: list[float]) -> None:
    xi = np.array([values])
    np.testing.assert_allclose(log_se3(exp_se3(xi)), xi, atol=1e-8)


def test_logarithm_is_the_matrix_logarithm() -> None:
    T = exp_se3(np.array([[0.3, -0.2, 0.5, 0.7, -0.4, 0.9]]))
    generator = logm(T[0])
    np.testing.assert_allclose(log_se3(T)[0, :3], generator[:3, 3], atol=1e-9)


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_jacobians_equal_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = exp_se3(rng.normal(size=(2, 6)) * 0.5)
    T = exp_se3(rng.normal(size=(1, 6)) * 0.02) @ poses[1:] @ inverse(poses[:1])
    edges = Edges(np.array([0]), np.array([1]), T, SIGMA[None], np.array([False]))
    for node, jacobian in enumerate(edge_jacobians(poses, edges)):
        for axis in range(6):
            moved = [poses.copy(), poses.copy()]
            for side, sign in zip(moved, (1, -1), strict=True):
                side[node] = exp_se3(sign * 1e-5 * np.eye(6)[axis]) @ side[node]
            difference = (edge_errors(moved[0], edges) - edge_errors(moved[1], edges))[0] / 2e-5
            np.testing.assert_allclose(
                jacobian[0, :, axis], difference, atol=2e-2 * np.abs(jacobian).max()
            )


@pytest.mark.parametrize("seed", range(3))
def test_loops_remove_drift(seed: int) -> None:
    truth = square()
    drifted, edges = graph(truth, np.random.default_rng(seed), rounds(len(truth)))
    solved, weights = optimize_graph(drifted, edges, LoopConfig())
    # The noise of one lap remains; two laps without a loop drift much further.
    exact = Edges(
        edges.first,
        edges.second,
        truth[edges.second] @ inverse(truth[edges.first]),
        edges.sigmas,
        edges.robust,
    )
    assert error(optimize_graph(drifted, exact, LoopConfig())[0], truth) < 1e-3 * error(
        drifted, truth
    )
    assert error(solved, truth) < 0.5 * error(drifted, truth)
    assert weights[edges.robust].min() > 0.3
    np.testing.assert_array_equal(solved[0], drifted[0])


def test_one_loop_around_a_square_removes_yaw_drift() -> None:
    truth = square(laps=1)
    drift = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, -0.006, 0.0]))  # 0.3 degrees of drift per step
    motions = drift @ truth[1:] @ inverse(truth[:-1])
    drifted = [truth[0]]
    for motion in motions:
        drifted.append(motion @ drifted[-1])
    poses, last = np.stack(drifted), len(truth) - 1
    edges = Edges(
        np.r_[np.arange(last), 0],
        np.r_[np.arange(1, last + 1), last],
        np.concatenate([motions, (truth[last] @ inverse(truth[0]))[None]]),
        np.tile(SIGMA, (last + 1, 1)),
        np.arange(last + 1) == last,
    )
    solved, _ = optimize_graph(poses, edges, LoopConfig())
    assert error(poses, truth) > 0.2
    assert error(solved, truth) < error(poses, truth) / 5


def test_wrong_loop_loses_its_weight() -> None:
    truth = square()
    n = len(truth)
    drifted, right = graph(truth, np.random.default_rng(1), rounds(n))
    wrong = Edges(
        np.r_[right.first, 5],
        np.r_[right.second, n // 2 + 20],
        np.concatenate([right.T, np.eye(4)[None]]),
        np.concatenate([right.sigmas, SIGMA[None]]),
        np.r_[right.robust, True],
    )
    solved, weights = optimize_graph(drifted, wrong, LoopConfig())
    assert weights[-1] < 1e-3
    assert weights[right.robust.nonzero()[0]].min() > 0.3
    assert error(solved, truth) < 1.1 * error(
        optimize_graph(drifted, right, LoopConfig())[0], truth
    )


def test_edges_refuse_arrays_of_different_shape() -> None:
    with pytest.raises(ValueError, match="disagree"):
        Edges(np.array([0]), np.array([1]), np.eye(4)[None], np.ones((1, 3)), np.array([True]))
