"""Cameras that looked ahead, in a block of which nothing says where down is.

Without positions, tilts and control, a similarity of the block is free (Luhmann et al. 2020, section 4.4.3).
Its tilt comes from cameras that are taken to look down. Where they all look ahead, level land is one slope.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.ground.ground_choice import LEAST_POINTS
from geomosaic.adjustment.model import Block
from geomosaic.adjustment.procedure.block_solution import BlockSolution
from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import exp_turn
from geomosaic.constants import ROUNDS, SLIGHT, tuned
from geomosaic.estimation.linear import eigen_each
from geomosaic.estimation.robust import LEAST_OBSERVATIONS, cauchy_weight
from geomosaic.placement.prior import position_assumed, tilt_assumed
from geomosaic.survey.accuracy import ATTITUDE

_AHEAD = tuned(
    2.0, "deviations", "of an assumed tilt: less turns hillsides; more leaves cameras that look ahead"
)


@dataclass(frozen=True)
class LevelledBlock:
    """A block whose cameras are taken to look at level ground as they do on the whole. poses: the solved ones
    turned as one, to begin with. ahead_deg: by how much the cameras look ahead."""

    block: Block
    poses: Poses
    ahead_deg: float


def levelled_block(block: Block, found: BlockSolution) -> LevelledBlock | None:
    """The block with other assumed tilts, where nobody observed a position, a tilt or a control point, and
    most frames look at their ground more obliquely than assumed tilts explain. None elsewhere.

    Cameras are mounted alike: the direction across the ground in camera axes is their median.
    """
    assumed = position_assumed(block.poses) & tilt_assumed(block.poses)
    known = not assumed.all() or any(not c.check for c in block.control)
    if known or block.ground.kind == "dem" or found.ties.points < LEAST_POINTS:
        return None
    solved, points_m = found.solution.poses, found.of_ties.points_m
    order = np.argsort(found.ties.frame, kind="stable")
    frames, first = np.unique(found.ties.frame[order], return_index=True)
    across = [
        _across(points_m[its]) @ solved.rotations[i]
        for i, its in zip(frames, np.split(found.ties.point[order], first[1:]), strict=True)
        if len(its) >= LEAST_OBSERVATIONS
    ]
    if not across:
        return None
    usual = np.median(across, axis=0)
    usual = usual / np.linalg.norm(usual)
    ahead = float(np.arccos(usual[2]))
    if ahead <= _AHEAD * np.radians(ATTITUDE["none"].sd_tilt_deg):
        return None
    up = solved.rotations @ usual
    whole = _upright(np.median(up, axis=0)[None])[0]
    middle_m = np.median(points_m, axis=0)
    level_m = [*middle_m[:2], float(block.ground.up_at(*middle_m[:2]))]
    velocities = solved.velocities_m_per_s
    poses = replace(
        solved,
        positions_m=(solved.positions_m - middle_m) @ whole.T + level_m,
        rotations=whole @ solved.rotations,
        velocities_m_per_s=None if velocities is None else velocities @ whole.T,
    )
    prior = replace(block.poses, positions_m=poses.positions_m, rotations=_upright(up) @ solved.rotations)
    return LevelledBlock(replace(block, poses=prior), poses, float(np.degrees(ahead)))


def _across(points_m: Floats) -> Floats:
    """The direction (3,), upwards, across the robust plane of points (p, 3): their least spread."""
    weight = np.ones(len(points_m))
    for _ in range(ROUNDS):
        spread = np.cov(points_m.T, aweights=weight)
        normal = eigen_each(spread[None])[1][0, :, 0]
        off = np.abs((points_m - np.average(points_m, axis=0, weights=weight)) @ normal)
        weight = cauchy_weight(off / max(1.5 * float(np.median(off)), SLIGHT))
    return np.asarray(normal * np.copysign(1.0, normal[2]))


def _upright(directions: Floats) -> Floats:
    """The least turns (n, 3, 3) that bring directions (n, 3) up."""
    level = np.linalg.norm(directions[:, :2], axis=1)
    angle = np.arctan2(level, directions[:, 2]) / np.maximum(level, SLIGHT)
    return exp_turn(
        angle[:, None] * np.column_stack([directions[:, 1], -directions[:, 0], np.zeros(len(level))])
    )
