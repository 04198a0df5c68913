"""Symmetric positive definite systems of curves along a strip, whose knots meet only near ones: a band."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_triangular

from geomosaic.arrays import Floats
from geomosaic.estimation.linear import cholesky_of_band, solve_band


class Banded:
    """Cholesky factors of the matrix of n knots with b unknowns each.

    Args: diagonal (n, b, b) of each knot itself; off_diagonal: of each distance d from 1 on, (n - d, b), what
    joins unknowns of knot j to their own kind of knot j + d.

    Raises: NotSolvableError if the matrix is not positive definite.
    """

    def __init__(self, diagonal: Floats, off_diagonal: Sequence[Floats]) -> None:
        n, self._size = diagonal.shape[:2]
        off_diagonal = off_diagonal[: n - 1]
        reach = max(self._size * len(off_diagonal), self._size - 1)
        columns = np.zeros((n, self._size, reach + 1))  # of the lower triangle, from the diagonal on
        for d in range(self._size):
            along = np.arange(self._size - d)
            columns[:, along, d] = diagonal[:, along + d, along]
        for distance, band in enumerate(off_diagonal, 1):
            columns[: n - distance, :, self._size * distance] = band
        self._factor = cholesky_of_band(columns.reshape(n * self._size, -1).T, lower=True, overwrite=True)

    def solve(self, side: Floats) -> Floats:
        """Solutions (n b, r) for right sides (n b, r)."""
        return solve_band(self._factor, side, lower=True)

    def inverse_blocks(self) -> Floats:
        """The inverse's diagonal blocks (n, b, b), by the recursion of Takahashi et al. (1973)."""
        b, reach = self._size, len(self._factor) - 1
        unknowns = self._factor.shape[1]
        span = b * -(-reach // b)
        out = np.empty((unknowns // b, b, b))
        inverse = np.zeros((0, 0))
        for start in reversed(range(0, unknowns, span)):
            own = min(span, unknowns - start)
            skewed = np.zeros((own, reach + 1 + own))
            skewed[:, : reach + 1] = self._factor[:, start : start + own].T
            # Each column of the factor one farther on than the last: rows of the factor's transpose.
            rows = skewed.ravel()[: own * (reach + own)].reshape(own, reach + own)
            turned = solve_triangular(rows[:, :own].T, np.eye(own), lower=True, check_finite=False)
            carried = rows[:, own : own + len(inverse)].T @ turned
            met = len(carried)
            inverse = turned.T @ turned + carried.T @ (inverse[:met, :met] @ carried)
            knots = np.arange(own // b)
            out[start // b + knots] = inverse.reshape(len(knots), b, len(knots), b)[knots, :, knots, :]
        return out
