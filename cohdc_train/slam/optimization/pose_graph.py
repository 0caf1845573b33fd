"""Pose-graph optimization, with keyframes as nodes and a Cauchy kernel on loop edges.

It is a sparse implementation of our own rather than gtsam, whose wheel of 34 MB is larger than the
rest of the SLAM runner. A graph of this size is solved in well under a second.
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
    """Measured relative poses, e of them.

    first, second: [e] int64 nodes; T: [e, 4, 4] camera of `first` to camera of `second`, m; sigmas:
    [e, 2] standard deviations of (translation m, rotation rad); robust: [e] bool, True = the edge
    may be wrong and gets the Cauchy kernel.
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
    """Return the error [e, 6] of each edge in standard deviations.

    It is the logarithm of the nodes' relative pose times the inverse of the measured one.
    """
    relative = poses[edges.second] @ inverse(poses[edges.first])
    return log_se3(relative @ inverse(edges.T)) / np.repeat(edges.sigmas, 3, axis=1)


def edge_jacobians(poses: Array, edges: Edges) -> tuple[Array, Array]:
    """Return the Jacobians [e, 6, 6] of the edge errors by xi of the first and of the second node.

    They are exact to second order in the error.
    """
    scale = np.repeat(edges.sigmas, 3, axis=1)
    ad = adjoint_of_algebra(edge_errors(poses, edges) * scale)
    second = (np.eye(6) - 0.5 * ad + ad @ ad / 12) / scale[:, :, None]
    first = -second @ adjoint(poses[edges.second] @ inverse(poses[edges.first]))
    return first, second


def optimize_graph(poses: Array, edges: Edges, config: LoopConfig) -> tuple[Array, Array]:
    """Optimize all poses but node 0 by Levenberg-Marquardt.

    Every node must be connected with node 0. The Cauchy kernel of the robust edges starts so wide
    that each edge has at least half its weight, and narrows to config.cauchy_width. Correct loop
    edges thus act from the start, and wrong ones lose their weight.

    Args:
        poses: [n, 4, 4] T_cw, world to camera, m.
        edges: relative poses between the nodes.
        config: width of the kernel, rounds, and steps.

    Returns:
        The optimized poses, and the final weight 0..1 [e] of each edge.
    """
    final = config.cauchy_width**2
    start = _squared(poses, edges)[edges.robust].max(initial=final)
    for width2 in np.geomspace(start, final, config.graph_rounds):
        poses = _descend(poses, edges, width2, config.graph_steps)
    return poses, _weights(_squared(poses, edges), edges, final)


def _squared(poses: Array, edges: Edges) -> Array:
    """Return the squared error [e] of each edge, in variances."""
    error = edge_errors(poses, edges)
    return np.asarray(np.einsum("ea,ea->e", error, error))


def _weights(squared: Array, edges: Edges, width2: float) -> Array:
    """Return the Cauchy weight [e] of each edge, 1 for edges that are not robust."""
    return np.where(edges.robust, 1 / (1 + squared / width2), 1.0)


def _cost(squared: Array, edges: Edges, width2: float) -> float:
    """Return the total cost, with the Cauchy kernel on robust edges."""
    return float(np.where(edges.robust, width2 * np.log1p(squared / width2), squared).sum())


def _descend(poses: Array, edges: Edges, width2: float, steps: int) -> Array:
    """Run damped Gauss-Newton steps with a fixed width of the kernel."""
    damping = 1e-6
    squared = _squared(poses, edges)
    for _ in range(steps):
        step = _solve(poses, edges, _weights(squared, edges, width2), damping)
        moved = poses.copy()
        moved[1:] = exp_se3(step) @ poses[1:]
        new_squared = _squared(moved, edges)
        if _cost(new_squared, edges, width2) > _cost(squared, edges, width2):
            damping *= 100
            continue
        poses, squared, damping = moved, new_squared, damping / 10
        if np.abs(step).max() < 1e-5:  # 10 micrometers or microradians
            break
    return poses


def _solve(poses: Array, edges: Edges, weights: Array, damping: float) -> Array:
    """Solve the damped normal equations for the steps [n - 1, 6] of the nodes 1, 2, ..."""
    n, e = len(poses), len(edges.first)
    root = np.sqrt(weights)[:, None]
    blocks = [jacobian * root[..., None] for jacobian in edge_jacobians(poses, edges)]
    rows = np.repeat(np.arange(e * 6), 6).reshape(e, 6, 6)
    columns = [
        np.broadcast_to(node[:, None, None] * 6 + np.arange(6), (e, 6, 6))
        for node in (edges.first, edges.second)
    ]
    values = np.concatenate([block.ravel() for block in blocks])
    indices = (np.tile(rows.ravel(), 2), np.concatenate([c.ravel() for c in columns]))
    J = sparse.csc_matrix((values, indices), shape=(e * 6, n * 6))[:, 6:]
    H = J.T @ J
    H += sparse.diags(damping * H.diagonal() + 1e-9, format="csc")
    rhs = -(J.T @ (edge_errors(poses, edges) * root).ravel())
    return solve_symmetric(H, rhs).reshape(-1, 6)
