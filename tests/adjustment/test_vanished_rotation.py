"""Functions of the frames' rotation that vanish are not solved for by all tie points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly, hills

from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.procedure.block_solution import BlockSolution, BlockTask, block_solution
from geomosaic.adjustment.solver.solve import SolveOptions, solve
from geomosaic.adjustment.terms.rolling_shutter_rotation import RollingShutterRotation
from geomosaic.adjustment.terms.term import Components
from geomosaic.constants import varied
from geomosaic.matching.tracks import join_tracks

TURNING = Settings(turning=True, rolling_shutter=True)
TERM = "geomosaic.adjustment.terms.rolling_shutter_rotation"


@pytest.fixture(scope="module")
def found() -> BlockSolution:
    """Eight frames that each turn at a constant rate while they are read. Of thirty points a frame chance shows half
    an image deviation."""
    flown = fly(3, 2, 4, points=350, relief=hills, readout_s=0.1, rate_sd_rad_per_s=0.2)
    with varied(TERM, _SHOWN=0.5):
        return block_solution(
            BlockTask(flown.block, TURNING, join_tracks(flown.block.ties)), flown.block.poses
        )


def test_a_constant_rate_leaves_one_function(found: BlockSolution) -> None:
    """The other three are at their limit, so a step has 12 unknowns a frame and not 21."""
    begun = found.solution
    assert begun.estimate.rotation_terms_rad.shape == (8, 4, 3)
    with varied(TERM, _SHOWN=0.5):
        solved = solve(found.problem, begun.poses, begun, SolveOptions(near=True))
    assert solved.estimate.rotation_terms_rad.shape == (8, 1, 3)
    assert solved.stated.solved.pose_side.size == 8 * 12
    off_m = np.abs(solved.poses.positions_m - begun.poses.positions_m)
    assert (off_m < 0.1 * begun.poses.positions_sd_m).all()


def test_another_solve_goes_on_from_it(found: BlockSolution) -> None:
    """Its components count as estimated, also those of functions it left out."""
    begun = found.solution
    with varied(TERM, _SHOWN=0.5):
        solved = solve(found.problem, begun.poses, begun, SolveOptions(near=True))
        again = solve(found.problem, solved.poses, solved)
        anew = solve(found.problem, solved.poses)
    assert again.estimate.rotation_terms_rad.shape == (8, 4, 3)
    assert len(again.steps) <= len(anew.steps) / 2
    assert np.abs(again.poses.positions_m - begun.poses.positions_m).max() < 0.01


def test_only_the_last_functions_go() -> None:
    """One that vanishes before another that does not stays; all may, but one."""
    sds = np.full((5, 4, 3), 0.01), np.full((5, 3), 0.01)
    term = RollingShutterRotation(*sds, focal_length_px=1000.0, common=False, most_rotation=10.0)
    unseen = 0.09 * 0.3 / 10.0  # below a tenth of the image deviation, of 10 px at the rim
    sizes = {"image": 0.3} | {
        f"rotation term {k}": v for k, v in enumerate((0.5, unseen, 0.1, unseen), start=1)
    }
    assert term.without_vanished(Components(sizes)).terms == 3
    assert term.without_vanished(Components(sizes | {"image": 0.03})).terms == 4
    nothing = Components(dict.fromkeys(sizes, unseen) | {"image": 0.3})
    assert term.without_vanished(nothing).terms == 1
    assert replace(term, common=True).without_vanished(nothing).terms == 4


def test_what_the_images_show_stays() -> None:
    """The fourth function of frames that shake has a hundredth of the first deviation, but seven times that
    of the images. Without it the rest would bend to take it up, and the images seem half as good."""
    flown = fly(*(3, 2, 6), points=900, noise_px=0.03, readout_s=0.12, rate_sd_rad_per_s=0.04, shaking_hz=6.6)
    task = BlockTask(flown.block, TURNING, join_tracks(flown.block.ties))
    shaken = block_solution(task, flown.block.poses)
    begun = shaken.solution
    solved = solve(shaken.problem, begun.poses, begun, SolveOptions(near=True))
    assert solved.estimate.rotation_terms_rad.shape == (12, 4, 3)
    assert 0.005 < solved.components["rotation term 4"] < 0.02
    assert solved.components["image"] == pytest.approx(0.03, rel=0.1)
