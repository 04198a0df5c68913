"""Functions of the frames' rotation that vanish are not solved for by all tie points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly, hills

from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.procedure.block_solution import BlockSolution, BlockTask, block_solution
from geomosaic.adjustment.solver.solve import SolveOptions, solve
from geomosaic.adjustment.terms.rolling_shutter_rotation import LEAST_SWING, RollingShutterRotation
from geomosaic.adjustment.terms.term import Components
from geomosaic.matching.tracks import join_tracks

TURNING = Settings(turning=True, rolling_shutter=True)


@pytest.fixture(scope="module")
def found() -> BlockSolution:
    """Eight frames that each turn at a constant rate while they are read."""
    flown = fly(3, 2, 4, points=350, relief=hills, readout_s=0.1, rate_sd_rad_per_s=0.2)
    return block_solution(BlockTask(flown.block, TURNING, join_tracks(flown.block.ties)), flown.block.poses)


def test_a_constant_rate_leaves_one_function(found: BlockSolution) -> None:
    """The other three are at their limit, so a step has 12 unknowns a frame and not 21."""
    begun = found.solution
    assert begun.estimate.swing_rad.shape == (8, 4, 3)
    solved = solve(found.problem, begun.poses, begun, SolveOptions(near=True))
    assert solved.estimate.swing_rad.shape == (8, 1, 3)
    assert solved.stated.solved.pose_side.size == 8 * 12
    off_m = np.abs(solved.poses.positions_m - begun.poses.positions_m)
    assert (off_m < 0.1 * begun.poses.positions_sd_m).all()


def test_another_solve_goes_on_from_it(found: BlockSolution) -> None:
    """Its components count as estimated, also those of functions it left out."""
    begun = found.solution
    solved = solve(found.problem, begun.poses, begun, SolveOptions(near=True))
    again = solve(found.problem, solved.poses, solved)
    assert again.estimate.swing_rad.shape == (8, 4, 3)
    assert len(again.steps) <= len(solve(found.problem, solved.poses).steps) / 2
    assert np.abs(again.poses.positions_m - begun.poses.positions_m).max() < 0.01


def test_only_the_last_functions_go() -> None:
    """One that vanishes before another that does not stays; all may, but one."""
    term = RollingShutterRotation(np.ones((5, 4, 3)), np.ones((5, 3)), common=False, most_swing=10.0)
    sizes = {f"swing {k}": size for k, size in enumerate((0.5, LEAST_SWING, 0.1, LEAST_SWING), start=1)}
    assert term.without_vanished(Components(sizes)).terms == 3
    nothing = Components(dict.fromkeys(sizes, LEAST_SWING))
    assert term.without_vanished(nothing).terms == 1
    assert replace(term, common=True).without_vanished(nothing).terms == 4
