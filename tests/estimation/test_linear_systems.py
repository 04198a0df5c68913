"""The owner of all linear systems: what it refuses, what it leaves out, and that nobody goes past it."""

import ast
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.sparse import csc_matrix

import geomosaic
from geomosaic.errors import NotSolvableError
from geomosaic.estimation import linear

ROOMS = ("adjustment", "matching", "placement", "surface", "projection", "ccd")
SINGULAR = np.array([[1.0, 2.0], [2.0, 4.0]])
NEARLY = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-16]])
REGULAR = np.array([[4.0, 1.0], [1.0, 3.0]])
FORBIDDEN = {
    "inv", "solve", "lstsq", "pinv", "qr", "eigh", "eigvalsh", "eig", "svd", "cholesky", "cond",
    "splu", "spsolve", "cho_factor", "cholesky_banded", "solveh_banded", "dpotrf", "dpbtrf",
}  # fmt: skip
ANY = st.floats(allow_nan=True, allow_infinity=True, width=64)


def test_the_rooms_of_the_geometry_have_no_linear_algebra_of_their_own() -> None:
    for room in ROOMS:
        for path in (Path(geomosaic.__file__).parent / room).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Attribute) and ast.unparse(node.value).endswith("linalg"):
                    assert node.attr not in FORBIDDEN, f"{path}: {ast.unparse(node)}"
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(("scipy.", "numpy.")):
                    names = {a.name for a in node.names}
                    assert not names & FORBIDDEN, f"{path}: {names & FORBIDDEN}"


def test_a_system_is_solved_and_one_that_has_no_solution_refused() -> None:
    assert np.allclose(linear.solve(REGULAR, np.array([1.0, 2.0])), [1.0 / 11.0, 7.0 / 11.0])
    assert np.allclose(linear.inverse(REGULAR) @ REGULAR, np.eye(2))
    assert np.allclose(
        linear.solve_scaled(np.diag([1e-20, 1e20]), np.array([[1.0], [1.0]])).ravel(), [1e20, 1e-20]
    )
    for matrix in (SINGULAR, NEARLY, np.full((2, 2), np.nan), np.full((2, 2), np.inf)):
        with pytest.raises(NotSolvableError):
            linear.solve(matrix, np.ones(2))
        with pytest.raises(NotSolvableError):
            linear.solve_scaled(matrix, np.ones((2, 1)))
    with pytest.raises(NotSolvableError):
        linear.solve(REGULAR, np.array([np.nan, 0.0]))


def test_of_many_systems_those_that_fail_are_left_out() -> None:
    many = np.stack([REGULAR, SINGULAR, np.full((2, 2), np.nan), 2.0 * REGULAR])
    inverses = linear.inverse_each(many)
    assert np.isnan(inverses[1:3]).all()
    assert np.allclose(inverses[[0, 3]], [np.linalg.inv(REGULAR), 0.5 * np.linalg.inv(REGULAR)])
    values, axes = linear.eigen_each(many)
    assert np.isnan(values[2]).all() and np.isnan(axes[2]).all()
    assert np.allclose(values[1], [0.0, 5.0])


def test_a_factor_says_where_its_matrix_is_not_positive_definite() -> None:
    factor, broken_at = linear.cholesky(REGULAR)
    assert broken_at == -1 and np.allclose(factor @ factor.T, REGULAR)
    assert linear.cholesky(np.diag([1.0, 2.0, -1.0]))[1] == 2
    assert linear.cholesky(SINGULAR)[1] == 1
    assert linear.cholesky(np.array([[1.0, np.nan], [np.nan, 1.0]]))[1] == 1


def test_a_point_without_a_solution_takes_no_part() -> None:
    blocks = np.stack([np.diag([4.0, 9.0, 16.0]), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)])
    roots = linear.inverse_roots(blocks)
    assert np.allclose(roots[0], np.diag([0.5, 1.0 / 3.0, 0.25]))
    assert not roots[1:].any()


def test_bands_and_sparse_systems_that_have_no_solution_are_refused() -> None:
    band = np.array([[0.0, 1.0], [4.0, 3.0]])
    factor = linear.cholesky_of_band(band, lower=False)
    assert np.allclose(linear.solve_band(factor, np.array([1.0, 2.0]), lower=False), [1.0 / 11.0, 7.0 / 11.0])
    with pytest.raises(NotSolvableError):
        linear.cholesky_of_band(np.array([[0.0, 2.0], [1.0, 4.0]]), lower=False)
    assert np.allclose(
        linear.SparseFactors(csc_matrix(REGULAR)).solve(np.array([1.0, 2.0])), [1 / 11, 7 / 11]
    )
    for matrix in (SINGULAR, np.full((2, 2), np.nan)):
        with pytest.raises(NotSolvableError):
            linear.SparseFactors(csc_matrix(matrix))


@given(arrays(np.float64, (3, 3), elements=ANY), arrays(np.float64, (3, 2), elements=ANY))
def test_whatever_comes_in_no_exception_but_its_own_gets_out(matrix: np.ndarray, side: np.ndarray) -> None:
    with np.errstate(all="ignore"):
        symmetric = matrix + matrix.T
        for attempt in (
            lambda: linear.solve(matrix, side),
            lambda: linear.inverse(symmetric),
            lambda: linear.solve_scaled(symmetric, side),
            lambda: linear.least_squares(matrix, side),
            lambda: linear.cholesky_of_band(symmetric[:2], lower=True),
        ):
            try:
                attempt()
            except NotSolvableError:
                continue
        linear.solve_each(matrix[None], side[None])
        linear.eigen_each(symmetric[None])
        linear.pseudo_inverse(symmetric[None], symmetric=True)
        linear.inverse_roots(symmetric[None])
        linear.cholesky(symmetric)
