"""How earlier frames moved and turned while their rows were read: it stays as an earlier solution has it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Block, SolvedBlock
from geomosaic.adjustment.procedure.reported_corrections import with_solved_velocities
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.terms.rolling_shutter_rotation import RollingShutterRotation
from geomosaic.arrays import Ints
from geomosaic.camera.exterior import Poses, Turns


def with_earlier_velocities(block: Block, was: Ints, earlier: Poses) -> Block:
    """The block whose frames with a number (n,) of an earlier pose have that velocity; others have that of
    the path through all."""
    if block.poses.velocities_m_per_s is None or earlier.velocities_m_per_s is None:
        return block
    known = was >= 0
    positions_m = block.poses.positions_m.copy()
    positions_m[known] = earlier.positions_m[was[known]]
    block, _ = with_solved_velocities(block, replace(block.poses, positions_m=positions_m))
    assert block.poses.velocities_m_per_s is not None
    velocities = block.poses.velocities_m_per_s.copy()
    velocities[known] = earlier.velocities_m_per_s[was[known]]
    return replace(block, poses=replace(block.poses, velocities_m_per_s=velocities))


def with_earlier_turns(problem: BlockProblem, was: Ints, before: tuple[Poses, SolvedBlock]) -> BlockProblem:
    """The problem in which earlier frames turn and drift as before, and no further. Their velocities hold
    the drift. Args: was (n,): numbers of earlier poses, -1 of new ones; before: these poses, and how they
    were solved for."""
    poses, solved = before
    if not any(isinstance(t, RollingShutterRotation) for t in problem.frames):
        return problem
    terms, new = solved.rotation_terms_rad.shape[1], was < 0
    frames = tuple(
        replace(
            t,
            rotation_sd_rad=t.rotation_sd_rad[:, :terms] * new[:, None, None],
            drift_sd=t.drift_sd * new[:, None],
        )
        if isinstance(t, RollingShutterRotation)
        else t
        for t in problem.frames
    )
    reported = replace(problem.image.reported, turns=_turns_of(poses.turns, was))
    return replace(problem, frames=frames, image=replace(problem.image, reported=reported))


def with_motion_of_before(found: Solution, names: tuple[str, ...], solved: SolvedBlock) -> Solution:
    """The solution with rotation and drift of the earlier frames as they were solved for."""
    at, row = found.estimate, {name: k for k, name in enumerate(solved.names)}
    rows = np.array([row.get(name, -1) for name in names])
    if not at.rotation_terms_rad.shape[1]:
        return found
    terms = np.where((rows >= 0)[:, None, None], solved.rotation_terms_rad[rows], at.rotation_terms_rad)
    drift = np.where((rows >= 0)[:, None], solved.drift[rows], at.drift)
    return replace(found, estimate=replace(at, rotation_terms_rad=terms, drift=drift))


def merged_motion(poses: Poses, was: Ints, before: Poses, part: tuple[Poses, Ints] | None) -> Poses:
    """Poses with earlier velocities and turns, and those of new frames as found. part: poses of a part and
    the numbers of its frames."""
    velocities, turns = poses.velocities_m_per_s, _turns_of(before.turns, was)
    if velocities is not None and before.velocities_m_per_s is not None:
        velocities = velocities.copy()
        velocities[was >= 0] = before.velocities_m_per_s[was[was >= 0]]
    if part is not None:
        found, frames = part
        new = np.flatnonzero(was[frames] < 0)
        if velocities is not None and found.velocities_m_per_s is not None:
            velocities[frames[new]] = found.velocities_m_per_s[new]
        if turns is not None and found.turns is not None:
            for k in new.tolist():
                turns.rad[frames[k]] = found.turns[k].tabled(turns.span_s, turns.rad.shape[1]).rad
    return replace(poses, velocities_m_per_s=velocities, turns=turns)


def _turns_of(turns: Turns | None, was: Ints) -> Turns | None:
    """Turns of frames by their numbers (n,) in those, none where that is -1."""
    if turns is None:
        return None
    rad = np.where((was >= 0)[:, None, None], turns.rad[was], 0.0)
    return Turns(turns.span_s, rad)
