"""Systems of curves against their dense twins."""

from __future__ import annotations

import numpy as np
import pytest

from geomosaic.ccd.banded import Banded
from geomosaic.errors import NotSolvableError


def system(n, b, reach, seed):
    rng = np.random.default_rng(seed)
    diagonal = rng.standard_normal((n, b, b))
    diagonal = diagonal @ diagonal.transpose(0, 2, 1) + 4.0 * reach * np.eye(b)
    off_diagonal = [rng.uniform(-1.0, 1.0, (n - d, b)) for d in range(1, reach + 1)]
    dense = np.zeros((n, b, n, b))
    for j in range(n):
        dense[j, :, j] = diagonal[j]
        for d in range(1, min(reach, n - 1 - j) + 1):
            dense[j, :, j + d] = dense[j + d, :, j] = np.diag(off_diagonal[d - 1][j])
    return diagonal, off_diagonal, dense.reshape(n * b, n * b)


@pytest.mark.parametrize(("n", "b", "reach"), [(40, 6, 5), (37, 4, 12), (9, 3, 8), (5, 2, 1), (1, 4, 0)])
def test_solutions_and_inverse_are_those_of_the_dense_matrix(n, b, reach):
    diagonal, off_diagonal, dense = system(n, b, reach, n)
    factors = Banded(diagonal, off_diagonal)
    side = np.random.default_rng(1).standard_normal((n * b, 3))
    np.testing.assert_allclose(factors.solve(side), np.linalg.solve(dense, side), rtol=1e-9)
    inverse = np.linalg.inv(dense).reshape(n, b, n, b)[np.arange(n), :, np.arange(n)]
    np.testing.assert_allclose(factors.inverse_blocks(), inverse, rtol=1e-8, atol=1e-12)


def test_what_is_not_determined_is_refused():
    with pytest.raises(NotSolvableError):
        Banded(np.zeros((4, 2, 2)), [])
