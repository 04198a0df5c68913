"""Velocities from solved positions, at the scale of the given positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Block
from geomosaic.camera.exterior import Poses
from geomosaic.constants import tuned
from geomosaic.estimation.similarity import fit_similarity
from geomosaic.placement.prior import position_assumed
from geomosaic.placement.velocity import flown_m_per_s

_OTHER_VELOCITY = tuned(0.1, "share of the velocity", "that justifies a new solve; less has no effect")
_MOST_SCALE = tuned(1.5, "times", "given by solved paths; beyond it the positions show no scale")


def flown(block: Block, poses: Poses) -> tuple[Block, bool]:
    """The block with velocities of solved poses, and whether one differs by a tenth from the given: wrong
    positions, gaps and ends of lines falsify given velocities.

    Rolling shutters tie the size of the block to velocities, so the scale is that of given positions.
    """
    given, times_s = block.poses.velocities_m_per_s, block.times_s
    if given is None or times_s is None or not np.isfinite(times_s).any():
        return block, False
    known, scale = ~position_assumed(block.poses), 1.0
    if known.sum() >= 3:
        turn, _ = fit_similarity(poses.positions_m[known, :2], block.poses.positions_m[known, :2])
        scale = float(abs(turn)) if 1.0 / _MOST_SCALE < abs(turn) < _MOST_SCALE else 1.0
    velocities = flown_m_per_s(scale * poses.positions_m, times_s)
    velocities = np.where(np.isfinite(times_s)[:, None], velocities, given)
    off, speed = (np.linalg.norm(v, axis=1) for v in (velocities - given, velocities))
    other = bool((off > _OTHER_VELOCITY * speed).any())
    return replace(block, poses=replace(block.poses, velocities_m_per_s=velocities)), other
