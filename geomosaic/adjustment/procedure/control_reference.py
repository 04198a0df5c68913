"""Georeferencing of a block without positions by its control points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Block
from geomosaic.adjustment.procedure.control_marks import Free, in_several_images, rays_meet_m
from geomosaic.camera.exterior import Poses
from geomosaic.constants import tuned
from geomosaic.estimation.linear import singular_values
from geomosaic.estimation.similarity import Similarity3D
from geomosaic.placement.prior import position_assumed

_DOUBT_RAD = tuned(0.1, "rad", "of a turn about a line of points: more turns blocks over")


def placed_by_control(block: Block, free: Free) -> Poses | None:
    """The free block's poses after the similarity of space onto the control points.

    None where a frame has a position, or with fewer than three control points in two images each or on a
    line: then similarities of the plane georeference the block. So it is where frames would be tilted by more
    than they are stated to, and the points' errors leave open how the block turns about the line that they
    lie along.
    """
    used = [c for c in in_several_images(block.control) if not c.check]
    if len(used) < 3 or not position_assumed(block.poses).all():
        return None
    poses, cameras = free(replace(block, control=()))
    at = np.array([rays_meet_m(poses, cameras, c) for c in used])
    known = np.isfinite(at).all(axis=1)
    at, there = at[known], np.array([c.enu_m for c in used])[known]
    onto = Similarity3D.through(at, there)
    if onto is None or onto.scale <= 0.0:
        return None
    off_m = float(np.median(np.linalg.norm(onto.of(at) - there, axis=1)))
    across_m = singular_values(there - there.mean(axis=0))[1][1] / np.sqrt(len(there))
    rotations = onto.rotation @ poses.rotations
    tilts_rad = np.arccos(np.clip(rotations[:, 2, 2], -1.0, 1.0))
    usual_rad = float(np.median(block.poses.rotations_sd_rad[:, :2]))
    if np.median(tilts_rad) > usual_rad and off_m > _DOUBT_RAD * across_m:
        return None
    return replace(block.poses, positions_m=onto.of(poses.positions_m), rotations=rotations)
