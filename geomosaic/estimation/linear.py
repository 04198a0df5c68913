"""Linear systems: every inverse, factorisation and eigen-decomposition of the geometry.

A system that is not finite or too badly conditioned for double precision raises `NotSolvableError`; of many
small systems (`*_each`) such ones become NaN. No exception of a linear algebra library gets out.
"""

from __future__ import annotations

from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dgecon, dgetrf, dgetrs, dlauum, dpotrf, dtrtri
from scipy.sparse import spmatrix
from scipy.sparse.linalg import splu

from geomosaic.arrays import Bools, Complexes, Floats
from geomosaic.errors import NotSolvableError

Values = TypeVar("Values", Floats, Complexes)
_PRECISION: Final = float(np.finfo(np.float64).eps)
_SINGULAR: Final = "a system of equations is singular"
_NOT_FINITE: Final = "a system of equations holds values that are not finite"


def solve(matrix: Floats, side: Floats) -> Floats:
    """Solution (n, r) or (n,) of one system (n, n). Raises: `NotSolvableError` where it is not finite, or
    singular to double precision (the reciprocal condition number in the 1-norm is below 2.2e-16; LAPACK's
    dgecon)."""
    _check_finite(matrix, side)
    if not len(matrix):
        return side.copy()
    factors, pivots, broken = dgetrf(matrix)
    if broken or dgecon(factors, np.abs(matrix).sum(axis=0).max())[0] < _PRECISION:
        raise NotSolvableError(_SINGULAR)
    return np.asarray(dgetrs(factors, pivots, side)[0]).reshape(side.shape)


def inverse(matrix: Floats) -> Floats:
    """Inverse of one matrix (n, n). Raises: as `solve`."""
    return solve(matrix, np.eye(len(matrix)))


def solve_scaled(matrix: Floats, side: Floats) -> Floats:
    """Solution (n, r) of a symmetric system whose unknowns differ in unit, scaled to a unit diagonal first.
    Raises: as `solve`, and where a number of the diagonal is not above zero."""
    _check_finite(matrix, side)
    if not (np.diag(matrix) > 0.0).all():
        raise NotSolvableError(_SINGULAR)
    scale = 1.0 / np.sqrt(np.diag(matrix))[:, None]
    return np.asarray(scale * solve(matrix * scale * scale.T, scale * side))


def solve_each(matrices: Floats, sides: Floats) -> Floats:
    """Solutions (..., n, r) of many small systems (..., n, n); NaN for the singular and those not finite."""
    good: Bools = np.asarray(np.isfinite(matrices).all(axis=(-2, -1)) & np.isfinite(sides).all(axis=(-2, -1)))
    out = np.full(np.broadcast_shapes(matrices.shape[:-2], sides.shape[:-2]) + sides.shape[-2:], np.nan)
    try:
        out[good] = np.linalg.solve(matrices[good], sides[good])
    except np.linalg.LinAlgError:
        good &= _regular(matrices, good)
        out[good] = np.linalg.solve(matrices[good], sides[good])
    return out


def inverse_each(matrices: Floats) -> Floats:
    """Inverses (..., n, n) of many small matrices; NaN for those that are not finite or singular."""
    return solve_each(matrices, np.broadcast_to(np.eye(matrices.shape[-1]), matrices.shape))


def multiply_each(left: Floats, right: Floats) -> Floats:
    """Products of m matrices (i, j, m) with m matrices (j, k, m) or vectors (j, m): (i, k, m) or (i, m)."""
    across = left if right.ndim == 2 else left[:, :, None]
    out = across[:, 0] * right[0]
    for j in range(1, len(right)):
        out += across[:, j] * right[j]
    return np.asarray(out)


def cross_each(one: Floats, other: Floats) -> Floats:
    """Vector products of m vectors each, (3, m)."""
    out = np.empty_like(one)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(one[j], other[k], out=out[i])
        out[i] -= one[k] * other[j]
    return out


def _regular(matrices: Floats, finite: Bools) -> Bools:
    """Which of many matrices (...) are finite and not singular to double precision."""
    out = finite.copy()
    out[finite] = np.linalg.cond(matrices[finite]) < 1.0 / _PRECISION
    return out


def eigen_each(matrices: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues (..., n), rising, and eigenvectors in columns of many symmetric matrices; NaN if not
    finite."""
    good = np.isfinite(matrices).all(axis=(-2, -1))
    values = np.full(matrices.shape[:-1], np.nan)
    vectors = np.full(matrices.shape, np.nan)
    values[good], vectors[good] = np.linalg.eigh(matrices[good])
    return values, vectors


def least_squares(design: Values, observed: Values, rcond: float | None = None) -> Values:
    """Least-squares solution of the smallest norm, (n,) or (n, r), for a design (m, n) of any rank. Args:
    rcond: singular values below this share of the largest count as zero. Raises: `NotSolvableError` where a
    value is not finite."""
    _check_finite(design, observed)
    found: Any = np.linalg.lstsq(design, observed, rcond=rcond)[0]
    return np.asarray(found, design.dtype)


def paraboloid_design(plan: Floats) -> Floats:
    """Polynomials of the second degree at places in plan (k, 2), scaled to their extent, (k, 6)."""
    e, n = ((plan - plan.mean(axis=0)) / max(float(np.ptp(plan, axis=0).max()), 1e-9)).T
    return np.stack([np.ones_like(e), e, n, e * e, e * n, n * n], axis=1)


def pseudo_inverse(matrix: Floats, *, symmetric: bool = False) -> Floats:
    """Moore and Penrose's inverse (..., n, m) of matrices (..., m, n) of any rank; NaN where not finite."""
    good = np.isfinite(matrix).all(axis=(-2, -1))
    out = np.full((*matrix.shape[:-2], matrix.shape[-1], matrix.shape[-2]), np.nan)
    out[good] = np.linalg.pinv(matrix[good], hermitian=symmetric)
    return out


def orthonormal(columns: Floats) -> Floats:
    """An orthonormal basis (m, n) of the columns (m, n), n <= m. Raises: as `least_squares`."""
    _check_finite(columns)
    return np.asarray(np.linalg.qr(columns)[0])


def singular_values(matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Singular value decomposition U, s, V' of a matrix (m, n): (m, k), (k,) falling, (k, n), k = min(m, n).
    Raises: as `least_squares`."""
    _check_finite(matrix)
    u, sizes, vt = np.linalg.svd(matrix, full_matrices=False)
    return np.asarray(u), np.asarray(sizes), np.asarray(vt)


def is_parallel(normal: Floats, most: float) -> bool:
    """Whether a normal matrix (n, n) is not finite, or has a condition number above `most`."""
    return not np.isfinite(normal).all() or float(np.linalg.cond(normal)) > most


def cholesky(matrix: Floats, *, overwrite: bool = False) -> tuple[Floats, int]:
    """Lower Cholesky factor of one symmetric matrix (n, n), and the number of the unknown at which it fails,
    else -1. It fails where the matrix is not finite or not positive definite to double precision. The upper
    triangle is not read. Args: overwrite: a matrix in the order of columns becomes the factor."""
    diagonal = np.diag(matrix).copy()
    factor, broken = dpotrf(matrix, lower=1, clean=1, overwrite_a=overwrite)
    pivots = np.diag(factor)
    good = np.isfinite(pivots) & (pivots**2 > _PRECISION * diagonal)
    return np.asarray(factor), broken - 1 if broken else -1 if good.all() else int(good.argmin())


def inverse_of_factor(factor: Floats) -> Floats:
    """Inverse (n, n), in the order of columns, of a factor of `cholesky`."""
    return np.asarray(dtrtri(factor, lower=1)[0])


def square_of_factor(factor: Floats) -> Floats:
    """L' L (n, n) of a lower triangular matrix, in the order of columns: its lower triangle alone."""
    return np.asarray(dlauum(factor, lower=1)[0])


def inverse_roots(blocks: Floats) -> Floats:
    """L^-1 (p, 3, 3) of symmetric positive definite blocks L L' (p, 3, 3). It is zero for a block that is not
    positive definite or not finite: its unknowns take no part."""
    v = np.ascontiguousarray(np.moveaxis(blocks, 0, -1))
    out = np.zeros_like(v)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        a = 1.0 / np.sqrt(v[0, 0])
        p, q = v[1, 0] * a, v[2, 0] * a
        b = 1.0 / np.sqrt(v[1, 1] - p * p)
        r = (v[2, 1] - p * q) * b
        c = 1.0 / np.sqrt(v[2, 2] - q * q - r * r)
        out[0, 0], out[1, 1], out[2, 2] = a, b, c
        out[1, 0], out[2, 1] = -p * a * b, -r * b * c
        out[2, 0] = (p * r * b - q) * a * c
    out[..., ~np.isfinite(out).all(axis=(0, 1))] = 0.0
    return np.ascontiguousarray(np.moveaxis(out, -1, 0))


def cholesky_of_band(band: Floats, *, lower: bool, overwrite: bool = False) -> Floats:
    """Cholesky factor of a banded symmetric matrix, in LAPACK's band storage (reach + 1, n). Raises:
    `NotSolvableError` where it is not finite or not positive definite."""
    _check_finite(band)
    try:
        factor = cholesky_banded(band, overwrite_ab=overwrite, lower=lower, check_finite=False)
    except np.linalg.LinAlgError:
        raise NotSolvableError(_SINGULAR) from None
    return np.asarray(factor)


def solve_band(factor: Floats, side: Floats, *, lower: bool) -> Floats:
    """Solution (n, ...) by a factor of `cholesky_of_band`."""
    return np.asarray(cho_solve_banded((factor, lower), side, check_finite=False))


class SparseFactors:
    """LU factors of one sparse matrix (n, n). Raises: `NotSolvableError` where it is not finite or exactly
    singular."""

    def __init__(self, matrix: spmatrix) -> None:
        columns = matrix.tocsc()
        _check_finite(columns.data)
        try:
            self._factors = splu(columns)
        except RuntimeError:  # SuperLU's word for a singular factor
            raise NotSolvableError(_SINGULAR) from None

    def solve(self, side: Floats) -> Floats:
        """Solution (n,) or (n, r). Raises: `NotSolvableError` where it is not finite."""
        found = np.asarray(self._factors.solve(side))
        _check_finite(found)
        return found


def _check_finite(*arrays: NDArray[Any]) -> None:
    for array in arrays:
        if not np.isfinite(array).all():
            raise NotSolvableError(_NOT_FINITE)
