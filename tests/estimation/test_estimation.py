"""Robust estimation: blunders lose their weight, and options of similarities do what they say."""

from __future__ import annotations

import numpy as np
import pytest

from geomosaic.estimation.robust import irls, redescending_weight
from geomosaic.estimation.similarity import Similarity3D, fit_similarity, similarity_design


def test_blunders_do_not_move_a_line() -> None:
    x = np.linspace(0.0, 1.0, 50)
    observed = 2.0 + 3.0 * x
    observed[:8] += 40.0
    design = np.column_stack([np.ones(50), x])
    found, weight = irls(
        design, observed, lambda left: redescending_weight(np.abs(left) / 0.1), np.array([2.1, 2.9])
    )
    assert found == pytest.approx([2.0, 3.0], abs=1e-4)
    assert weight[:8].max() < 1e-5 and weight[8:].min() == 1.0


def test_two_components_share_a_weight() -> None:
    """A similarity of the plane by irls is that of the closed form."""
    rng = np.random.default_rng(1)
    z = rng.normal(0.0, 10.0, (30, 2)) @ [1, 1j]
    w = (1.1 + 0.2j) * z + 5.0 + rng.normal(0.0, 0.1, (30, 2)) @ [1, 1j]
    source, target = (np.column_stack([v.real, v.imag]) for v in (z, w))
    design = np.moveaxis(similarity_design(z), 0, 1)
    weigh = lambda left: np.ones((len(left), 1))  # noqa: E731
    (a, b, east, north), _ = irls(design, target, weigh)
    turn, shift = fit_similarity(source, target, 1)
    assert (a + 1j * b, east + 1j * north) == (pytest.approx(turn), pytest.approx(shift))


def test_a_blunder_that_comes_first_spoils_no_similarity() -> None:
    """Of 40 points the first is kilometres off: other triples are tried."""
    rng = np.random.default_rng(3)
    points = rng.normal(0.0, 100.0, (40, 3))
    to = 1.5 * points + [10.0, -20.0, 5.0]
    to[0] += rng.normal(0.0, 5000.0, 3)
    found = Similarity3D.through(points, to)
    assert found is not None and found.scale == pytest.approx(1.5, abs=1e-6)
