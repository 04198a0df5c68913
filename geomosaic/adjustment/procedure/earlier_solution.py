"""The block begun from the solution of an earlier run: most of its frames, its cameras and variances."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from geomosaic.adjustment.model import Block, Settings, SolvedBlock
from geomosaic.adjustment.paper.misalignment import offset_net
from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.procedure.block_solution import BlockTask, block_solution
from geomosaic.adjustment.procedure.initialisation import placed_by_images, start_poses
from geomosaic.adjustment.procedure.outcome import BlockState
from geomosaic.adjustment.procedure.reported_corrections import with_common_heading, with_solved_velocities
from geomosaic.adjustment.solver.solution import Start
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Bools
from geomosaic.camera.exterior import Poses
from geomosaic.constants import SLIGHT, tuned
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.matching.tracks import Tracks
from geomosaic.placement.collocation import moved_with_neighbours
from geomosaic.placement.prior import position_assumed
from geomosaic.spread import Spread

EARLIER: Final = "the earlier solution"
"""What the solve that begins from it is called."""
_MOST_COST = tuned(1.01, "times", "cost an observation with the old model: more keeps one that fits no more")
_LEAST_KNOWN = tuned(0.5, "share of the frames", "solved earlier: with fewer new ones decide")


def begun_from_earlier(
    given: Block, asked: Settings, all_and_few: tuple[Tracks, Tracks], spread: Spread
) -> BlockState | None:
    """The block with the earlier run's model, solved by few tie points from its solution; frames that are new
    begin where the images put them relative to it. None where that solution says too little of the block.

    Raises: NotSolvableError.
    """
    earlier, (tracks, few) = given.earlier, all_and_few
    known_lenses = {} if earlier is None else {c.name: c for c in earlier.lenses}
    if earlier is None or given.poses.turns is not None or not tracks.points:
        return None
    known = np.array([name in earlier.names for name in given.names])
    if known.mean() < _LEAST_KNOWN or any(c.name not in known_lenses for c in given.cameras):
        return None
    settings = replace(
        earlier.settings, ground=asked.ground, self_calibration=asked.self_calibration, model=asked.model
    )
    net = offset_net(given)
    poses = with_earlier_poses(start_poses(given, net), earlier, given, known)
    block = replace(given, cameras=tuple(known_lenses[c.name] for c in given.cameras))
    block, notes = with_common_heading(placed_by_images(block, poses), poses)
    rolling = settings.rolling_shutter or any(c.readout_s for c in block.cameras)
    if rolling:
        block, _ = with_solved_velocities(block, poses)
        poses = replace(poses, velocities_m_per_s=block.poses.velocities_m_per_s)
    start = start_from_earlier(block, settings, few, poses)
    found = block_solution(BlockTask(block, settings, few, few is not tracks), poses, start)
    misalignments_m = net.misalignments_m(np.zeros((net.n, 2)))
    return BlockState(
        *(given, misalignments_m, tracks, few, rolling, block, settings, found, spread),
        choice=earlier.choice,
        notes=tuple(notes),
        steps=found.steps,
    )


def still_fits(work: BlockState, earlier: SolvedBlock) -> bool:
    """Whether the earlier model explains image observations as well as it did then, but for chance. Frames
    differ in how well any model explains them, by blur and relief. So a frame is the unit of chance, and two
    blocks differ as means of so many frames do (cluster sampling: Cochran 1977, Sampling Techniques, section
    9.2)."""
    now, before = work.found.solution.components[IMAGE], Components(earlier.components)[IMAGE]
    image, solution = work.found.problem.image, work.found.solution
    of_frames = image.frame_variances(solution.estimate, solution.components)
    scatter = float(np.std(of_frames)) / max(float(np.mean(of_frames)), SLIGHT)
    chance = scatter * np.sqrt(1.0 / len(of_frames) + 1.0 / len(earlier.names))
    return bool((now / before) ** 2 <= _MOST_COST + THREE_SIGMA * chance)


def with_earlier_poses(begun: Poses, earlier: SolvedBlock, block: Block, known: Bools) -> Poses:
    """The earlier poses of known frames; of the others the initial ones, moved as their neighbours were.

    Positions that the images put farther away than their deviations allow begin where they are reported.
    With the earlier variance components they would pass for blunders, and stay wrong.
    """
    at = {name: k for k, name in enumerate(earlier.names)}
    rows = np.array([at[name] for name, its in zip(block.names, known, strict=True) if its], dtype=np.intp)

    def moved(poses: Poses) -> Poses:
        positions_m, rotations = poses.positions_m.copy(), poses.rotations.copy()
        positions_m[known], rotations[known] = earlier.positions_m[rows], earlier.rotations[rows]
        found = replace(poses, positions_m=positions_m, rotations=rotations)
        return moved_with_neighbours(poses, found, known, ~known)

    by_images, given = moved(begun), block.poses
    positions_m = moved(given).positions_m
    near = np.abs(by_images.positions_m - positions_m) <= THREE_SIGMA * given.positions_sd_m
    by_image = known | position_assumed(given) | near.all(axis=1)
    return replace(
        by_images,
        positions_m=np.where(by_image[:, None], by_images.positions_m, positions_m),
        positions_sd_m=begun.positions_sd_m,
        rotations_sd_rad=begun.rotations_sd_rad,
    )


def start_from_earlier(block: Block, settings: Settings, tracks: Tracks, poses: Poses) -> Start:
    """What a solve of the block goes on from; points begin where the rays of these poses meet."""
    earlier = block.earlier
    assert earlier is not None
    layout = block_problem(block, settings, tracks, np.zeros((tracks.points, 3))).layout
    known = {name: (values, earlier.fixed[name]) for name, values in earlier.shared.items()}
    shared, fixed = layout.begun_from(known)
    at = {name: k for k, name in enumerate(earlier.names)}
    rows = np.array([at.get(name, -1) for name in block.names])
    rotation_terms_rad = np.where((rows >= 0)[:, None, None], earlier.rotation_terms_rad[rows], 0.0)
    drift = np.where((rows >= 0)[:, None], earlier.drift[rows], 0.0)
    points_m = np.zeros((0, 3))
    estimate = Estimate(
        layout, poses.positions_m, poses.rotations, points_m, shared, rotation_terms_rad, drift
    )
    found = {c.name: c for c in earlier.cameras}
    cameras = tuple(found[c.name] for c in block.lenses)
    return Start(poses, cameras, estimate, Components(earlier.components), fixed, None)
