"""Solution of symmetric linear systems."""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from cohdc_train.slam.geometry.se3 import Array


def solve_symmetric(matrix: sparse.sparray | sparse.spmatrix, right: Array) -> Array:
    """Solve a sparse, symmetric, positive definite linear system.

    Args:
        matrix: sparse [n, n].
        right: [n] right-hand side.

    Returns:
        x [n] of matrix @ x = right.
    """
    options = {"SymmetricMode": True}
    factors = splu(
        sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
    )
    return np.asarray(factors.solve(right), dtype=np.float64)
