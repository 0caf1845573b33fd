"""Solution of symmetric linear systems."""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from cohdc_train.slam.geometry.se3 import Array


def solve_symmetric(matrix: sparse.sparray | sparse.spmatrix, right: Array) -> Array:
    """Solve matrix @ x = right for x [n].

    matrix: sparse [n, n], symmetric and positive definite; right: [n].
    """
    options = {"SymmetricMode": True}
    factors = splu(
        sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
    )
    return np.asarray(factors.solve(right), dtype=np.float64)
