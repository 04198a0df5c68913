"""Which shared unknowns a block does not determine."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import estimate_of, fly

from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.procedure.block_solution import points_on_ground
from geomosaic.adjustment.solver import solution
from geomosaic.adjustment.solver.solution import undetermined
from geomosaic.adjustment.terms.term import Components
from geomosaic.estimation.linear import inverse
from geomosaic.matching.tracks import join_tracks


def one_by_one(covariance: np.ndarray) -> list[int]:
    """By one inverse for each number."""
    shown, left, out = inverse(covariance) - np.eye(len(covariance)), list(range(len(covariance))), []
    while left:
        share = np.sqrt(np.diag(inverse(shown[np.ix_(left, left)] + np.eye(len(left)))))
        worst = int(share.argmax())
        if share[worst] < 0.7:
            break
        out.append(left.pop(worst))
    return out


def test_a_number_that_is_known_once_another_is_stays_free() -> None:
    """Deviations of 0.77 and 0.74, both above 0.7; that of the second is 0.37 once the first is known."""
    assert solution._weak(np.array([[0.6, 0.5], [0.5, 0.55]])).tolist() == [0]
    assert solution._weak(np.diag([0.6, 0.4, 0.9])).tolist() == [2, 0]
    assert solution._weak(np.ones((2, 2))).tolist() == [0, 1], "singular"


@pytest.mark.parametrize("seed", range(20))
def test_the_same_numbers_as_by_one_inverse_for_each(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shown = rng.normal(0.0, 1.0, (15, 40)) * rng.choice([0.01, 0.3, 3.0], 40)
    covariance = inverse(np.eye(40) + shown.T @ shown)
    found = solution._weak(covariance).tolist()
    assert found == one_by_one(covariance)
    assert 0 < len(found) < 40


def test_a_block_of_many_cameras_takes_one_inverse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve frames, each with a camera of its own: 108 numbers, of which most stay as given."""
    flown = fly(1, 2, 6, points=300)
    cameras = tuple(replace(c, name=f"{i}") for i, c in enumerate(flown.block.cameras))
    block, sizes = replace(flown.block, cameras=cameras), []
    points, tracks = points_on_ground(flown.truth, cameras, block.ground, join_tracks(block.ties))
    problem = block_problem(block, Settings(), tracks, points)

    def counted(matrix: np.ndarray) -> np.ndarray:
        sizes.append(len(matrix))
        return inverse(matrix)

    monkeypatch.setattr(solution, "inverse", counted)
    found = undetermined(problem, estimate_of(problem, block.poses), Components())
    assert found.sum() > 60 and len(sizes) == 1
