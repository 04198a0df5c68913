"""What keeps a block from converging: points that wander alone, and components that follow what was assumed."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import estimate_of, fly, hills

from geomosaic.adjustment.kernels.reduced_equations import reduce_normals
from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.procedure.block_solution import points_on_ground
from geomosaic.adjustment.solver import single_points
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.solver.single_points import converged_points, wandering
from geomosaic.adjustment.solver.variance_components import _ahead
from geomosaic.adjustment.terms.frame_components import PRIOR_FACTORS
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.adjustment.terms.term import Component, Components
from geomosaic.matching.tracks import Tracks, join_tracks

COMPONENTS = Components({IMAGE: 0.3})
GROUPS = "horizontal", "vertical", "tilt", "yaw"


def at_truth(points: int, blunders: int) -> tuple[BlockProblem, Estimate]:
    """A block at its true poses, its points on the ground below; some tracks have one image 4 px off."""
    flown = fly(5, relief=hills, points=points)
    block, tracks = flown.block, join_tracks(flown.block.ties)
    image_px = tracks.image_px.copy()
    wrong = np.searchsorted(tracks.point, np.flatnonzero(tracks.lengths > 2)[:blunders])
    image_px[wrong, 0] += 4.0
    ground, tracks = points_on_ground(
        flown.truth, block.cameras, block.ground, Tracks(tracks.frame, tracks.point, image_px)
    )
    problem = replace(block_problem(block, Settings(), tracks, ground), terrain=None)
    return problem, estimate_of(problem, flown.truth)


def test_points_go_where_their_images_want_them_while_all_others_stand() -> None:
    """Cost falls, and of slopes nothing is left; also where an image contradicts the others."""
    problem, at = at_truth(400, 40)
    which = np.arange(0, problem.tracks.points, 2)
    at_best = at
    for _ in range(3):
        at_best = converged_points(problem, at_best, COMPONENTS, which, 0.01)
    assert problem.cost(at_best, COMPONENTS) < problem.cost(at, COMPONENTS)
    assert at_best.points_m[1::2] == pytest.approx(at.points_m[1::2], abs=0.0)
    assert at_best.positions_m is at.positions_m
    reduced = reduce_normals(problem.normals(at_best, COMPONENTS))
    side = reduced.normals.point_side
    off = np.sqrt(np.einsum("pi,pij,pj->p", side, reduced.points_inverse, side))
    assert np.quantile(off[which], 0.99) < 0.02
    assert np.median(off[1::2]) > 1.0


def test_points_a_few_at_a_time_are_those_of_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, at = at_truth(400, 40)
    which = np.arange(1, problem.tracks.points, 3)
    together = converged_points(problem, at, COMPONENTS, which, 0.01)
    monkeypatch.setattr(single_points, "AT_ONCE", 25)
    apart = converged_points(problem, at, COMPONENTS, which, 0.01)
    assert np.ptp(together.points_m[which] - at.points_m[which]) > 0.0
    assert apart.points_m == pytest.approx(together.points_m, abs=1e-9)


def test_who_wanders_are_the_farthest_of_a_large_block_alone() -> None:
    problem, at = at_truth(4000, 10)
    everyone = np.arange(problem.tracks.points)
    for _ in range(3):
        at = converged_points(problem, at, COMPONENTS, everyone, 0.01)
    thrown = np.array([7, 500, 2900])
    points = at.points_m.copy()
    points[thrown] += [0.5, 0.3, 4.0]
    reduced = reduce_normals(problem.normals(replace(at, points_m=points), COMPONENTS))
    assert set(thrown) <= set(wandering(reduced, 0.01).tolist())
    assert len(wandering(reduced, 0.01)) < 0.04 * problem.tracks.points
    problem, at = at_truth(400, 10)
    assert not len(wandering(reduce_normals(problem.normals(at, COMPONENTS)), 0.01))


def found_tilt(factor: float) -> list[Component]:
    """Components of the frames' observations as found from residuals: 1 but for that of tilts."""
    least, most, none = *PRIOR_FACTORS, np.zeros((0, 6))
    factors = {**dict.fromkeys(GROUPS, 1.0), "tilt": factor}
    return [Component(name, its, none, none, 1.0, 1.0, 0.0, least, most) for name, its in factors.items()]


def test_a_component_that_follows_what_was_assumed_goes_its_whole_way() -> None:
    """Found by a rule that halves what is missing to 2.4, it is there at once, not in five rounds."""
    end, followed = 2.4, np.zeros((4, 4))
    followed[2, 2] = 0.5
    sent, change = _ahead(found_tilt(float(np.exp(0.5 * np.log(end)))), Components(), followed)
    assert sent["tilt"] == pytest.approx(end)
    assert change == pytest.approx(np.log(end))
    assert (sent["horizontal"], sent["vertical"], sent["yaw"]) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("following", [1.2, 0.99])
def test_no_component_goes_back_or_beyond_bounds(following: float) -> None:
    followed = np.zeros((4, 4))
    followed[2, 2] = following
    sent, _ = _ahead(found_tilt(1.3), Components(), followed)
    assert 1.0 < sent["tilt"] <= 1.3**4 + 1e-9
