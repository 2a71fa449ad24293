"""Affine matrix functions of a real vector, handed to cvxpy as one product with constant coefficients."""

from __future__ import annotations

from collections.abc import Callable

import cvxpy as cp
import numpy as np

from controller.lti import Array


def affine(function: Callable[[Array], Array], x: cp.Expression) -> cp.Expression:
    """function(x), for an affine `function` from vectors (p,) to matrices, by its values at 0 and the unit vectors.

    Compiling a block matrix of expressions costs cvxpy far more than these p + 1 evaluations.
    """
    constant = function(np.zeros(x.size))
    slopes = np.stack([(function(e) - constant).ravel() for e in np.eye(x.size)], axis=1)
    return cp.reshape(slopes @ x + constant.ravel(), constant.shape, order="C")


def packed(n: int) -> int:
    """Number of free entries of a symmetric matrix (n, n)."""
    return n * (n + 1) // 2


def symmetric_from(vector: Array, n: int) -> Array:
    """The symmetric (n, n) matrix whose upper triangle, row by row, is `vector`."""
    M = np.zeros((n, n))
    M[np.triu_indices(n)] = vector
    return M + np.triu(M, 1).T
