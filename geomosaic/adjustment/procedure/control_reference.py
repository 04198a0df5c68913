"""Control points against a block adjusted without them: the scale of their marks, the place of the block."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Block, GroundControl
from geomosaic.adjustment.procedure.blunder_detection import WITHIN_PX
from geomosaic.adjustment.procedure.control_points import intersection_of_rays
from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.estimation.linear import singular_values
from geomosaic.estimation.robust import STRONG, cauchy_cost
from geomosaic.estimation.similarity import Similarity3D
from geomosaic.placement.prior import position_assumed
from geomosaic.survey.model import Warn

Free = Callable[[Block], tuple[Poses, tuple[Camera, ...]]]
"""Poses and the camera of each frame, of a block adjusted without control points."""
_BY_CHANCE = tuned(1e-6, "probability", "of marks all near the first corner, if spread over whole images")
_STEP = tuned(0.01, "share", "between the scales that are tried first; then a twentieth of it")
_DOUBT_RAD = tuned(0.1, "rad", "of a turn about a line of points: more turns blocks over")


def in_several_images(control: Sequence[GroundControl]) -> list[GroundControl]:
    """Points with marks in two images or more."""
    return [c for c in control if len({frame for frame, _, _ in c.observations}) > 1]


def rays_meet_m(
    poses: Poses, cameras: Sequence[Camera], control: GroundControl, scale: float = 1.0
) -> Floats:
    """The nearest point (3,) in m to the rays of a control point's marks, enlarged by scale."""
    frames = np.array([i for i, _, _ in control.observations], dtype=np.intp)
    marks_px = np.array([(scale * col, scale * row) for _, col, row in control.observations])
    return intersection_of_rays(poses, tuple(cameras), frames, marks_px)


def with_marks_of_whole_images(block: Block, free: Free) -> tuple[Block, tuple[Warn, ...]]:
    """The block with enlarged image marks, where all lie near the first corner and rays of one point meet at
    one enlargement alone: some programs write marks of reduced images, which no file states."""
    marks, several = (
        [mark for c in block.control for mark in c.observations],
        in_several_images(block.control),
    )
    sizes = [(block.cameras[i].width_px, block.cameras[i].height_px) for i, _, _ in marks]
    share = max((max(m[1] / w, m[2] / h) for m, (w, h) in zip(marks, sizes, strict=True)), default=0.0)
    if not several or share <= 0.0 or share ** (2 * len(marks)) > _BY_CHANCE:
        return block, ()
    poses, cameras = free(replace(block, control=()))

    def cost(scale: float) -> float:
        miss_px = np.concatenate([_miss_px(poses, cameras, c, scale) for c in several])
        return float(cauchy_cost(miss_px / scale / WITHIN_PX).sum()) / 2.0

    best = min(np.arange(1.0, 1.0 / share, _STEP).tolist(), key=cost)
    best = min((best + np.linspace(-_STEP, _STEP, 41)).tolist(), key=cost)
    if best < 1.0 + _STEP or cost(1.0) - cost(best) < np.log(STRONG):
        return block, ()
    text = (
        f"all {len(marks)} image marks of the control points lie in the first {100.0 * share:.0f} % of the "
        f"width and height of their images, and their rays meet if the marks are enlarged by {best:.3f}: "
        "taken as measured in images reduced by that; give marks of the full images to be sure"
    )
    enlarged = tuple(
        replace(c, observations=tuple((i, best * col, best * row) for i, col, row in c.observations))
        for c in block.control
    )
    return replace(block, control=enlarged), (Warn("control-marks-enlarged", "", text),)


def _miss_px(poses: Poses, cameras: Sequence[Camera], control: GroundControl, scale: float) -> Floats:
    """Distances (k,) of the enlarged marks from the image of their point, at most an image's longer side."""
    at_m, miss_px = rays_meet_m(poses, cameras, control, scale), []
    for i, col, row in control.observations:
        off = poses[i].image_from_ground(cameras[i], at_m) - [scale * col, scale * row]
        miss_px.append(np.fmin(np.linalg.norm(off), max(cameras[i].width_px, cameras[i].height_px)))
    return np.array(miss_px, dtype=np.float64)


def placed_by_control(block: Block, free: Free) -> Poses | None:
    """The free block's poses after the similarity of space onto the control points. None where a frame has a
    position, with fewer than three control points in two images each or on a line, or where frames would be
    tilted by more than stated while the points leave the turn about their line open; then similarities of the
    plane georeference the block."""
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
