"""The first solution of a block: similarities, then a bundle by few tie points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.paper.misalignment import offset_net
from geomosaic.adjustment.procedure.block_part import read_at_once
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.procedure.block_solution import BlockTask, block_solution, points_on_ground
from geomosaic.adjustment.procedure.initialisation import placed_by_images, start_poses
from geomosaic.adjustment.procedure.outcome import BlockState
from geomosaic.adjustment.procedure.reported_corrections import with_common_heading, with_solved_velocities
from geomosaic.adjustment.solver.solve import SolveOptions, solved_start
from geomosaic.camera.exterior import Poses
from geomosaic.matching.tracks import Tracks
from geomosaic.spread import Spread


def begun(
    given: Block,
    settings: Settings,
    all_and_few: tuple[Tracks, Tracks],
    spread: Spread,
    start: Poses | None = None,
) -> BlockState:
    """Similarities, or initial poses, then a bundle; with a rolling shutter first with all rows read at
    once."""
    tracks, few = all_and_few
    net = offset_net(given)
    start = start or start_poses(given, net)
    block, start, notes = with_common_heading(placed_by_images(given, start), start)
    rolling = settings.rolling_shutter or any(c.readout_s for c in block.cameras)
    if rolling:
        start = _read_at_once(block, settings, few, start)
        block, _ = with_solved_velocities(block, start)
    misalignments_m = net.misalignments_m(np.zeros((net.n, 2)))
    del net  # where every tie point lies, twice
    found = block_solution(BlockTask(block, settings, few, few is not tracks), start)
    return BlockState(
        *(given, misalignments_m, tracks, few, rolling, block, settings, found, spread),
        notes=tuple(notes),
        steps=found.steps,
    )


def _read_at_once(block: Block, settings: Settings, tracks: Tracks, start: Poses) -> Poses:
    """Poses as if all rows were read at once, with lenses as given: good enough to show how fast the platform
    flew. Velocities by given positions are wrong where frames are a few metres apart, and lenses would absorb
    that."""
    points, kept = points_on_ground(start, block.cameras, block.ground, tracks)
    if not len(points):
        return start
    settings = replace(settings, rolling_shutter=False, turning=False)
    options = SolveOptions(rough=True, self_calibration=False)
    problem = block_problem(read_at_once(block), settings, kept, points)
    solved = solved_start(problem, start, None, options)
    return replace(solved.poses, velocities_m_per_s=start.velocities_m_per_s, turns=start.turns)
