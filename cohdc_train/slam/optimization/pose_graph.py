"""Pose-graph optimisation: keyframes as nodes, relative poses as edges, loops under a Cauchy
kernel.

Own and sparse instead of gtsam: its wheel weighs 34 MB, more than the rest of the SLAM runner, and
a graph of this size is solved in well under a second here.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cohdc_train.slam.config import LoopConfig
from cohdc_train.slam.geometry.se3 import (
    Array,
    adjoint,
    adjoint_of_algebra,
    exp_se3,
    inverse,
    log_se3,
)
from cohdc_train.slam.optimization.linear_solver import solve_symmetric


@dataclass(frozen=True)
class Edges:
    """e measured relative poses.

    first, second: [e] int64 nodes; T: [e, 4, 4] camera of `first` to camera of `second`, m; sigmas:
    [e, 2] standard deviation of (translation m, rotation rad); robust: [e] bool, whether the edge
    may be wrong.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    T: Array
    sigmas: Array
    robust: NDArray[np.bool_]

    def __post_init__(self) -> None:
        e = len(self.first)
        shapes = (self.second.shape, self.T.shape, self.sigmas.shape, self.robust.shape)
        if shapes != ((e,), (e, 4, 4), (e, 2), (e,)):
            raise ValueError(f"edges disagree in shape: {shapes}")


def edge_errors(poses: Array, edges: Edges) -> Array:
    """[e, 6] log of (the relative pose that the nodes have, times the inverse of the measured one),
    in sigmas.
    """
    has = poses[edges.second] @ inverse(poses[edges.first])
    return log_se3(has @ inverse(edges.T)) / np.repeat(edges.sigmas, 3, axis=1)


def edge_jacobians(poses: Array, edges: Edges) -> tuple[Array, Array]:
    """d error / d xi of the first and of the second node, [e, 6, 6] each, to second order in the
    error.
    """
    scale = np.repeat(edges.sigmas, 3, axis=1)
    ad = adjoint_of_algebra(edge_errors(poses, edges) * scale)
    second = (np.eye(6) - 0.5 * ad + ad @ ad / 12) / scale[:, :, None]
    first = -second @ adjoint(poses[edges.second] @ inverse(poses[edges.first]))
    return first, second


def optimize_graph(poses: Array, edges: Edges, config: LoopConfig) -> tuple[Array, Array]:
    """Levenberg-Marquardt on all poses but node 0, which holds still and must be connected with
    every other.

    poses: [n, 4, 4] T_cw. The Cauchy kernel of the robust edges begins so wide that each has at
    least half its weight and narrows to config.cauchy_width, so that a right loop pulls from the
    start and a wrong one lets go. Returns the poses and [e] the final weight 0..1 of each edge.
    """
    final = config.cauchy_width**2
    start = _squared(poses, edges)[edges.robust].max(initial=final)
    for width2 in np.geomspace(start, final, config.graph_rounds):
        poses = _descend(poses, edges, width2, config.graph_steps)
    return poses, _weights(_squared(poses, edges), edges, final)


def _squared(poses: Array, edges: Edges) -> Array:
    error = edge_errors(poses, edges)
    return np.asarray(np.einsum("ea,ea->e", error, error))


def _weights(squared: Array, edges: Edges, width2: float) -> Array:
    return np.where(edges.robust, 1 / (1 + squared / width2), 1.0)


def _cost(squared: Array, edges: Edges, width2: float) -> float:
    return float(np.where(edges.robust, width2 * np.log1p(squared / width2), squared).sum())


def _descend(poses: Array, edges: Edges, width2: float, steps: int) -> Array:
    damping = 1e-6
    squared = _squared(poses, edges)
    for _ in range(steps):
        step = _solve(poses, edges, _weights(squared, edges, width2), damping)
        moved = poses.copy()
        moved[1:] = exp_se3(step) @ poses[1:]
        new = _squared(moved, edges)
        if _cost(new, edges, width2) > _cost(squared, edges, width2):
            damping *= 100
            continue
        poses, squared, damping = moved, new, damping / 10
        if np.abs(step).max() < 1e-5:  # 10 micrometres or microradians
            break
    return poses


def _solve(poses: Array, edges: Edges, weights: Array, damping: float) -> Array:
    """[n - 1, 6] step of the nodes 1, 2, ..."""
    n, e = len(poses), len(edges.first)
    root = np.sqrt(weights)[:, None]
    blocks = [jacobian * root[..., None] for jacobian in edge_jacobians(poses, edges)]
    rows = np.repeat(np.arange(e * 6), 6).reshape(e, 6, 6)
    columns = [
        np.broadcast_to(node[:, None, None] * 6 + np.arange(6), (e, 6, 6))
        for node in (edges.first, edges.second)
    ]
    values = np.concatenate([block.ravel() for block in blocks])
    places = (np.tile(rows.ravel(), 2), np.concatenate([c.ravel() for c in columns]))
    J = sparse.csc_matrix((values, places), shape=(e * 6, n * 6))[:, 6:]
    H = J.T @ J
    H += sparse.diags(damping * H.diagonal() + 1e-9, format="csc")
    right = -(J.T @ (edge_errors(poses, edges) * root).ravel())
    return solve_symmetric(H, right).reshape(-1, 6)
