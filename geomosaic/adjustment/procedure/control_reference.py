"""Georeferencing of a block without positions by its control points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Block
from geomosaic.adjustment.procedure.control_marks import Free, in_several_images, rays_meet_m
from geomosaic.camera.exterior import Poses
from geomosaic.estimation.similarity import Similarity3D
from geomosaic.placement.prior import position_assumed


def placed_by_control(block: Block, free: Free) -> Poses | None:
    """The free block's poses after the similarity of space onto the control points.

    None where a frame has a position, or with fewer than three control points in two images each or on a
    line: then similarities of the plane georeference the block.
    """
    used = [c for c in in_several_images(block.control) if not c.check]
    if len(used) < 3 or not position_assumed(block.poses).all():
        return None
    poses, cameras = free(replace(block, control=()))
    at = np.array([rays_meet_m(poses, cameras, c) for c in used])
    known = np.isfinite(at).all(axis=1)
    onto = Similarity3D.through(at[known], np.array([c.enu_m for c in used])[known])
    if onto is None or onto.scale <= 0.0:
        return None
    rotations = onto.rotation @ poses.rotations
    return replace(block.poses, positions_m=onto.of(poses.positions_m), rotations=rotations)
