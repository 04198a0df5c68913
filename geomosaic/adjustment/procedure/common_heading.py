"""What the headings of a block are off by in common: a gimbal's zero, a compass, a camera's mounting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Block
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import about_z
from geomosaic.constants import NORMAL_PER_MAD, tuned
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.prior import heading_assumed, heading_limits_rad, position_assumed
from geomosaic.survey.model import Warn

_LEAST_FRAMES = tuned(
    4,
    "frames with position and heading",
    "of a part: with fewer, one wrong position turns it as wrong headings would",
)


def with_common_heading(block: Block, start: Poses) -> tuple[Block, list[Warn]]:
    """The block with the headings of each connected part turned by what they are off by in common, and a
    warning for each part that is turned.

    Headings of n frames that share an error outweigh positions: the block would be turned to them and shrink,
    by the cosine of the error. A part's turn comes from its positions, where `start_poses` found that they
    contradict the headings; the median of the frames' turns is common where it is beyond each frame's limit
    and the frames' own scatter.
    """
    observed = ~heading_assumed(block.poses)
    known = observed & ~position_assumed(block.poses)
    limit = heading_limits_rad(block.poses)
    turned = np.einsum("nij,nkj->nik", start.rotations, block.poses.rotations)
    angle = np.arctan2(turned[:, 1, 0] - turned[:, 0, 1], turned[:, 0, 0] + turned[:, 1, 1])
    common, warnings = np.zeros(len(angle)), []
    for part in connected_parts(len(block.names), block.ties.frames):
        mine = np.array([i for i in part if known[i]], dtype=np.intp)
        if len(mine) < _LEAST_FRAMES:
            continue
        mean = np.angle(np.exp(1j * angle[mine]).sum())
        apart = np.angle(np.exp(1j * (angle[mine] - mean)))
        off = float(np.angle(np.exp(1j * (mean + np.median(apart)))))
        scatter = NORMAL_PER_MAD * float(np.median(np.abs(apart - np.median(apart))))
        if abs(off) <= max(float(np.median(limit[mine])), 2.0 * scatter):
            continue
        common[part] = np.where(observed[part], off, 0.0)
        text = (
            f"the headings of {int(observed[part].sum())} frames are {abs(np.degrees(off)):.0f} degrees too "
            f"{'small' if off < 0.0 else 'large'} in common, as their positions show; corrected"
        )
        warnings.append(Warn("headings-off", "", text))
    rotations = about_z(common) @ block.poses.rotations
    return replace(block, poses=replace(block.poses, rotations=rotations)), warnings
