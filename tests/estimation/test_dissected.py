"""Factors of blocks of frames, part by part, against the whole matrix."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import bsr_matrix

from geomosaic.adjustment.procedure.initialisation import _normals, _Ties
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.linear import (
    cholesky,
    cross_each,
    inverse_of_factor,
    multiply_each,
    square_of_factor,
)
from geomosaic.estimation.nested_dissection import Bordered, Dissected, Dissection
from geomosaic.estimation.similarity import similarity_design


def _system(meets: np.ndarray, seed: int, b: int = 6) -> tuple[bsr_matrix, np.ndarray]:
    """A positive definite matrix of (b, b) blocks where frames meet, as frames come in any order; the same
    dense."""
    rng = np.random.default_rng(seed)
    f = len(meets)
    shuffled = rng.permutation(f)
    meets = (meets | meets.T | np.eye(f, dtype=bool))[np.ix_(shuffled, shuffled)]
    dense = rng.normal(0.0, 1.0, (f, b, f, b)) * meets[:, None, :, None]
    dense = dense.reshape(f * b, f * b) + dense.reshape(f * b, f * b).T
    dense += np.diag(np.abs(dense).sum(axis=1) + rng.uniform(0.5, 2.0, f * b))
    return bsr_matrix(dense, blocksize=(b, b)), dense


def _near(places: np.ndarray, reach: tuple[int, int]) -> np.ndarray:
    return np.all(np.abs(places[:, None] - places[None]) <= reach, axis=2)


def _grid(lines: int, per_line: int) -> np.ndarray:
    return np.stack(np.divmod(np.arange(lines * per_line), per_line), axis=1)


SHAPES = {
    "one frame": np.ones((1, 1), dtype=bool),
    "all meet": np.ones((40, 40), dtype=bool),
    "a line": _near(_grid(1, 90), (0, 3)),
    "frames about one": np.eye(60, dtype=bool) | (np.arange(60) == 30)[:, None],
    "six lines": _near(_grid(6, 25), (1, 3)),
    "two parts and single frames": np.kron(np.eye(2, dtype=bool), _near(_grid(1, 50), (0, 2)))
    & (np.arange(100) % 9 != 0)[:, None],
    "a line that ends where it began": _near(_grid(1, 80), (0, 2)) | (_near(_grid(1, 80), (0, 2))[:, ::-1]),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_solutions_and_the_inverse_are_those_of_the_whole(shape: str) -> None:
    matrix, dense = _system(SHAPES[shape], 3, 4 if shape == "six lines" else 6)
    inverse = np.linalg.inv(dense)
    factors = Dissected(matrix)
    side = np.random.default_rng(5).normal(0.0, 1.0, (len(dense), 3))
    assert factors.solve(side) == pytest.approx(inverse @ side, rel=1e-9, abs=1e-13)
    b = matrix.blocksize[0]
    f = np.arange(len(dense) // b)
    own = inverse.reshape(len(f), b, len(f), b)[f, :, f, :]
    for _ in range(2):
        assert factors.inverse_blocks() == pytest.approx(own, rel=1e-9, abs=1e-13)
    assert factors.solve(side) == pytest.approx(inverse @ side, rel=1e-9, abs=1e-13)


def test_a_bordered_system_has_the_solution_of_the_whole() -> None:
    matrix, dense = _system(SHAPES["six lines"], 4, 3)
    rng = np.random.default_rng(6)
    border = rng.normal(0.0, 1.0, (len(dense), 5))
    corner = np.diag(rng.uniform(1.0, 2.0, 5)) + border.T @ np.linalg.solve(dense, border)
    whole = np.block([[dense, border], [border.T, corner]])
    order = Dissection.of(matrix.indices, matrix.indptr)
    for side in (rng.normal(0.0, 1.0, len(whole)), rng.normal(0.0, 1.0, (len(whole), 3))):
        wanted = np.linalg.solve(whole, side)
        for system in (Bordered(matrix, border, corner), Bordered(matrix, border, corner, order)):
            assert system.solve(side) == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_a_block_that_is_dense_in_the_graph_is_factorised_as_one_matrix() -> None:
    def fronts(meets: np.ndarray) -> int:
        matrix, _ = _system(meets, 2)
        return len(Dissection.of(matrix.indices, matrix.indptr).fronts)

    assert fronts(_near(_grid(5, 20), (4, 15))) == 1
    assert fronts(_near(_grid(5, 20), (1, 3))) > 3


@settings(deadline=None, max_examples=30)
@given(st.integers(2, 60), st.floats(0.0, 0.2), st.integers(0, 1000))
def test_any_frames_may_meet(frames: int, share: float, seed: int) -> None:
    meets = np.random.default_rng(seed).random((frames, frames)) < share
    matrix, dense = _system(meets, seed, 3)
    side = np.arange(3.0 * frames)[:, None] % 7.0
    assert Dissected(matrix).solve(side) == pytest.approx(np.linalg.solve(dense, side), rel=1e-8, abs=1e-12)


def test_a_matrix_that_is_not_positive_definite() -> None:
    _, dense = _system(SHAPES["a line"], 1)
    for row, value in ((77, -3.0), (500, 0.0), (12, np.nan)):
        bad = dense.copy()
        bad[row, row] = value
        with pytest.raises(NotSolvableError):
            Dissected(bsr_matrix(bad, blocksize=(6, 6)))


def test_a_factor_in_place_its_inverse_and_the_square_of_that() -> None:
    _, dense = _system(SHAPES["all meet"], 4, 2)
    upper = np.asfortranarray(np.tril(dense) + np.triu(np.full(dense.shape, 9.0), 1))
    factor, broken_at = cholesky(upper, overwrite=True)
    assert broken_at == -1
    assert np.shares_memory(factor, upper)
    np.testing.assert_allclose(factor, np.linalg.cholesky(dense), atol=1e-12)
    inverse = inverse_of_factor(factor)
    np.testing.assert_allclose(inverse @ factor, np.eye(len(dense)), atol=1e-12)
    np.testing.assert_allclose(np.tril(square_of_factor(inverse)), np.tril(np.linalg.inv(dense)), atol=1e-12)


def test_products_of_many_small_matrices() -> None:
    rng = np.random.default_rng(8)
    one, other, vectors = rng.normal(size=(2, 3, 50)), rng.normal(size=(3, 4, 50)), rng.normal(size=(3, 50))
    np.testing.assert_allclose(multiply_each(one, other), np.einsum("ijm,jkm->ikm", one, other))
    np.testing.assert_allclose(multiply_each(one, vectors), np.einsum("ijm,jm->im", one, vectors))
    np.testing.assert_allclose(cross_each(vectors, other[:, 0]).T, np.cross(vectors.T, other[:, 0].T))


def test_the_starts_equations_are_those_of_similarities_of_single_tie_points() -> None:
    rng = np.random.default_rng(4)
    a, b = np.repeat([[0, 0, 1, 0], [1, 3, 2, 1]], 5, axis=1)
    z_a, z_b, prior = (rng.normal(size=(n, 2)) @ [1, 1j] for n in (20, 20, 8))
    weight, prior_weight = rng.uniform(0.5, 2.0, 20), np.abs(prior).reshape(4, 2)
    design = np.zeros((2, 20, 4, 4))
    design[:, np.arange(20), a] += similarity_design(z_a)
    design[:, np.arange(20), b] -= similarity_design(z_b)
    rows, weights = design.reshape(40, 16), np.tile(weight, 2)
    y = z_b - z_a
    matrix, side = _normals(_Ties(a, b, z_a, z_b, 1.0 / weight), z_a, z_b, weight, prior_weight)
    wanted = (rows.T * weights) @ rows + np.diag(np.repeat(prior_weight.ravel(), 2))
    assert matrix.toarray() == pytest.approx(wanted, abs=1e-12)
    found = np.stack([side.real, side.imag], axis=-1).ravel()
    assert found == pytest.approx((rows.T * weights) @ np.concatenate([y.real, y.imag]), abs=1e-12)
