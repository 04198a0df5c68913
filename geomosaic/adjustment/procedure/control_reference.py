"""A block without positions, placed on the Earth by its control points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Block
from geomosaic.adjustment.procedure.control_marks import Free
from geomosaic.adjustment.procedure.control_points import intersection_of_rays
from geomosaic.camera.exterior import Poses
from geomosaic.estimation.similarity import Similarity3D
from geomosaic.placement.prior import position_assumed


def placed_by_control(block: Block, free: Free) -> Poses | None:
    """The free block's poses, shifted, turned and scaled in space onto the control points.

    None where a frame has a position, or fewer than three control points off one line are seen in two images
    each: then positions, or similarities of the plane, place the block.
    """
    used = [c for c in block.control if not c.check and len({i for i, _, _ in c.observations}) > 1]
    if len(used) < 3 or not position_assumed(block.poses).all():
        return None
    poses, cameras = free(replace(block, control=()))
    places = []
    for c in used:
        frames = np.array([i for i, _, _ in c.observations], dtype=np.intp)
        marks_px = np.array([at[1:] for at in c.observations])
        places.append(intersection_of_rays(poses, cameras, frames, marks_px))
    at = np.array(places)
    known = np.isfinite(at).all(axis=1)
    onto = Similarity3D.through(at[known], np.array([c.enu_m for c in used])[known])
    if onto is None or onto.scale <= 0.0:
        return None
    return replace(
        block.poses,
        positions_m=onto.of(poses.positions_m),
        rotations=onto.rotation @ poses.rotations,
    )
