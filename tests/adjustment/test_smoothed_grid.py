"""Heights of a grid's nodes: the equations as a band are those of the whole matrix."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geomosaic.adjustment.ground.trial_surface import SmoothedGrid


def dense(
    at: np.ndarray, up: np.ndarray, weight: np.ndarray, shape: tuple[int, int], spacing: float, off: float
) -> np.ndarray:
    """The same surface for curving 8 and a flying height of 100, by differences of whole matrices."""
    rows, cols = shape
    i, j = (np.floor(np.clip(at[:, k], 0.0, n - 1.001)).astype(int) for k, n in ((1, rows), (0, cols)))
    design = np.zeros((len(at), rows * cols))
    for di in (0, 1):
        for dj in (0, 1):
            share = (1 - np.abs(at[:, 1] - i - di)) * (1 - np.abs(at[:, 0] - j - dj))
            design[np.arange(len(at)), (i + di) * cols + j + dj] = share
    differences = lambda n, order: np.diff(np.eye(n), order, axis=0)  # noqa: E731
    stiff = 1e-12 * np.eye(rows * cols)
    for order, usual, times in ((1, 1.0, (1, 1)), (3, 8.0, (1, 3, 3, 1))):
        for across, often in enumerate(times):
            part = np.kron(differences(rows, across), differences(cols, order - across))
            stiff += often / (usual * spacing**order) ** 2 * part.T @ part
    stiff *= (20.0 * spacing) ** 2 / 100.0**2
    if off:
        stiff += (20.0 * spacing / (off * 100.0)) ** 2 * np.eye(rows * cols)
    solved = np.linalg.solve(design.T @ (weight[:, None] * design) + stiff, design.T @ (weight * up))
    return solved.reshape(rows, cols)


@settings(max_examples=20, deadline=None)
@given(
    rows=st.integers(2, 9), cols=st.integers(2, 9), off=st.sampled_from([0.0, 0.1]), seed=st.integers(0, 99)
)
def test_a_band_gives_what_the_whole_matrix_gives(rows: int, cols: int, off: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    at = rng.uniform(0.0, [cols - 1.01, rows - 1.01], (30, 2))
    up, weight = rng.normal(0.0, 5.0, 30), rng.uniform(0.1, 10.0, 30)
    grid = SmoothedGrid(at, (rows, cols), 0.05, 8.0, off)
    nodes = grid.fitted(up, weight, 100.0)
    expected = dense(at, up, weight, (rows, cols), 0.05, off)
    assert grid.arranged(nodes) == pytest.approx(expected, abs=1e-4)
    inside = np.array([[0.25, 0.5]])
    at_it = SmoothedGrid(inside, (rows, cols), 0.05, 8.0, off).at_points(nodes)
    corner = expected[:2, :2]
    assert at_it == pytest.approx([[0.5, 0.5] @ corner @ [0.75, 0.25]], abs=1e-4)
