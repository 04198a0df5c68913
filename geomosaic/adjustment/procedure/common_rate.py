"""The zero offset of the gyroscope: the common part of the frames' own rotation rates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.kernels.row_functions import with_swing
from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.constants import tuned

_LEAST_FRAMES = tuned(5, "frames", "fewer: the median is chance")
_OWN_SD_RAD_PER_S = tuned(0.012, "rad/s", "of a frame about the offset: 1 ms of delay in 10 rad/s²")


def with_common_rate(block: Block, settings: Settings, solved: Solution) -> tuple[Block, Settings]:
    """The block with the median of the frames' own rates, in camera axes, added to the reported rotations,
    and settings with a narrower prior of own rates. Rates as free as the offset weaken small blocks.
    """
    if not solved.estimate.swing_rad.shape[1] or block.poses.turns is None:
        return block, settings
    readouts_s = np.array([c.readout_s for c in block.cameras])
    known = solved.estimate.swing_rad.any(axis=(1, 2)) & (readouts_s > 0.0)
    if known.sum() < _LEAST_FRAMES:
        return block, settings
    common = np.median(solved.estimate.swing_rad[known, 0] / readouts_s[known, None], axis=0)
    poses = with_swing(block.poses, (readouts_s[:, None] * common)[:, None], readouts_s)
    return replace(block, poses=poses), replace(settings, rate_sd_rad_per_s=_OWN_SD_RAD_PER_S)
