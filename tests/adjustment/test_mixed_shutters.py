"""Frames whose rows are read at once among frames with a rolling shutter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly, hills

from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.procedure.block_solution import BlockTask, block_solution, points_on_ground
from geomosaic.adjustment.terms.rolling_shutter_rotation import RollingShutterRotation
from geomosaic.adjustment.terms.term import Components
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.matching.tracks import join_tracks

AT_ONCE = np.arange(12) % 3 == 1
GIVEN, TURNING = Settings(model="given"), Settings(model="given", turning=True)


def mixed(readout_s: float = 0.1) -> Flown:
    """Twelve frames that rotate at 0.2 rad/s. Every third is of a camera that reads all rows at once."""
    flown = fly(3, 2, 6, relief=hills, readout_s=readout_s, rate_sd_rad_per_s=0.2)
    whole = replace(flown.block.cameras[0], name="whole", readout_s=0.0)
    cameras = tuple(whole if its else c for c, its in zip(flown.block.cameras, AT_ONCE, strict=True))
    flown = replace(flown, block=replace(flown.block, cameras=cameras))
    east, north = np.meshgrid(np.linspace(-30.0, 70.0, 26), np.linspace(-20.0, 110.0, 31))
    land = np.column_stack([east.ravel(), north.ravel(), hills(east.ravel(), north.ravel())])
    seen: list[dict[int, tuple[float, float]]] = [{} for _ in cameras]
    for number, at in enumerate(land):
        for i, col, row in flown.seen(at, 0.3):
            seen[i][number] = col, row
    ties = []
    for i in range(12):
        for j in range(i + 1, 12):
            both = sorted(set(seen[i]) & set(seen[j]))
            if len(both) >= 12:
                px = (np.array([seen[k][n] for n in both]) for k in (i, j))
                ties.append(TiePair(i, j, *px, *(np.array(both, dtype=np.int32),) * 2))
    return replace(flown, block=replace(flown.block, ties=TiePoints(tuple(ties))))


def term_of(block: Block, settings: Settings) -> RollingShutterRotation:
    points, tracks = points_on_ground(block.poses, block.cameras, block.ground, join_tracks(block.ties))
    problem = block_problem(block, settings, tracks, points)
    return next(t for t in problem.frames if isinstance(t, RollingShutterRotation))


@pytest.mark.parametrize("settings", [GIVEN, TURNING], ids=["velocities", "turning"])
def test_frames_read_at_once_have_no_rotation_while_they_are_read(settings: Settings) -> None:
    """It would take up errors of the images, and no pose can contain it. That of the others is found."""
    flown = mixed()
    tracks = join_tracks(flown.block.ties)
    found = block_solution(BlockTask(flown.block, settings, tracks), flown.block.poses).solution
    terms_rad = found.estimate.rotation_terms_rad
    assert np.abs(terms_rad[AT_ONCE]).max() < 1e-5
    assert np.abs(found.estimate.drift[AT_ONCE]).max() < 1e-5
    if settings.turning:
        assert flown.truth.turns is not None
        true_rad = np.diff(flown.truth.turns.rad[:, [0, -1]], axis=1)[:, 0] / 2.0
        own = (terms_rad[:, 0] - true_rad)[~AT_ONCE]
        assert np.abs(own - np.median(own, axis=0)).max() < 0.002 < np.abs(true_rad).max() / 5.0


def test_their_numbers_count_nothing_in_variance_components() -> None:
    """The components' limits are those of the frames with a rolling shutter alone."""
    block = mixed().block
    term = term_of(block, TURNING)
    others = [replace(c, name="plain", readout_s=0.1) for c in block.cameras]
    of_all = term_of(replace(block, cameras=tuple(others)), TURNING)
    components = Components()
    assert term.sd(components)[~AT_ONCE] == pytest.approx(of_all.sd(components)[~AT_ONCE])
    assert np.all(term.sd(components)[AT_ONCE] == 1e-6)
    assert term._least(components) == pytest.approx(of_all._least(components))
