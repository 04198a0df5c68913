"""How fast the platform flew, by solved poses at the scale that positions say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Block
from geomosaic.camera.exterior import Poses
from geomosaic.constants import tuned
from geomosaic.estimation.similarity import fit_similarity
from geomosaic.placement.prior import position_assumed
from geomosaic.placement.velocity import flown_m_per_s

_OTHER_VELOCITY = tuned(
    0.1,
    "share of the velocity",
    "by which one differs so that the block is solved anew: less changes nothing that shows",
)
_MOST_SCALE = tuned(
    1.5,
    "times",
    "between solved and given paths: beyond, the positions are no measure of the scale either",
)


def flown(block: Block, poses: Poses) -> tuple[Block, bool]:
    """The block with the velocities of solved poses, and whether one differs from what it was by a tenth:
    those of given positions are wrong where one is far off, missing, or at the end of a line."""
    given = block.poses.velocities_m_per_s
    if given is None or block.times_s is None or not np.isfinite(block.times_s).any():
        return block, False
    velocities = flown_m_per_s(_scale(block, poses) * poses.positions_m, block.times_s)
    velocities = np.where(np.isfinite(block.times_s)[:, None], velocities, given)
    off, speed = (np.linalg.norm(v, axis=1) for v in (velocities - given, velocities))
    other = bool((off > _OTHER_VELOCITY * speed).any())
    return replace(block, poses=replace(block.poses, velocities_m_per_s=velocities)), other


def _scale(block: Block, poses: Poses) -> float:
    """Of the given positions against the solved ones. How far rows are stretched says how large a block is if
    velocities are known; those of a block that has come out too large would say that it is as large as that.
    """
    known = ~position_assumed(block.poses)
    if known.sum() < 3:
        return 1.0
    turn, _ = fit_similarity(poses.positions_m[known, :2], block.poses.positions_m[known, :2])
    return float(abs(turn)) if 1.0 / _MOST_SCALE < abs(turn) < _MOST_SCALE else 1.0
