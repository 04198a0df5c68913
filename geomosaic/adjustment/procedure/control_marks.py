"""Image marks of control points that were measured in reduced images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Block, GroundControl
from geomosaic.adjustment.procedure.control_points import intersection_of_rays
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.robust import cauchy_cost
from geomosaic.survey.model import Warn

Floats = NDArray[np.float64]
Free = Callable[[Block], tuple[Poses, tuple[Camera, ...]]]
"""Poses and the camera of each frame, of a block adjusted without control points."""
_BY_CHANCE = tuned(
    1e-6,
    "probability",
    "that marks spread over whole images all lie so near to the first corner",
)
_STEP = tuned(0.01, "share", "between the scales that are tried first; then a twentieth of it")
_MISS_PX = tuned(5.0, "px", "by which rays of good marks miss each other, block and marks together")
_SURELY = sourced(
    20.0,
    "times likelier",
    "evidence ratio that counts as strong",
    "Kass and Raftery 1995, section 3.2",
)


def with_marks_of_whole_images(block: Block, free: Free) -> tuple[Block, tuple[Warn, ...]]:
    """The block with its image marks enlarged, where all of them lie near the images' first corner and the
    rays of marks of one point meet at one enlargement alone.

    Programs that show images reduced write marks of the reduced size, and no file says so.
    """
    share = _farthest_share(block)
    marks = sum(len(c.observations) for c in block.control)
    if not marks or share <= 0.0 or share ** (2 * marks) > _BY_CHANCE:
        return block, ()
    several = [c for c in block.control if len({frame for frame, _, _ in c.observations}) > 1]
    if not several:
        return block, ()
    poses, cameras = free(replace(block, control=()))

    def cost(scale: float) -> float:
        miss_px = np.concatenate([_miss_px(poses, cameras, c, scale) for c in several])
        return float(cauchy_cost(miss_px / scale / _MISS_PX).sum()) / 2.0

    scales = np.arange(1.0, 1.0 / share, _STEP)
    rough = float(scales[np.argmin([cost(s) for s in scales])])
    near = rough + np.linspace(-_STEP, _STEP, 41)
    best = float(near[np.argmin([cost(s) for s in near])])
    if best < 1.0 + _STEP or cost(1.0) - cost(best) < np.log(_SURELY):
        return block, ()
    text = (
        f"all {marks} image marks of the control points lie in the first {100.0 * share:.0f} % of the "
        f"width and height of their images, and their rays meet if the marks are enlarged by {best:.3f}: "
        "taken as measured in images reduced by that; give marks of the full images to be sure"
    )
    enlarged = tuple(replace(c, observations=_enlarged(c, best)) for c in block.control)
    return replace(block, control=enlarged), (Warn("control-marks-enlarged", "", text),)


def _farthest_share(block: Block) -> float:
    """The largest share of an image's width or height at which a mark lies."""
    shares = [
        max(col / block.cameras[i].width_px, row / block.cameras[i].height_px)
        for c in block.control
        for i, col, row in c.observations
    ]
    return max(shares, default=0.0)


def _enlarged(control: GroundControl, scale: float) -> tuple[tuple[int, float, float], ...]:
    return tuple((i, scale * col, scale * row) for i, col, row in control.observations)


def _miss_px(poses: Poses, cameras: Sequence[Camera], control: GroundControl, scale: float) -> Floats:
    """How far each enlarged mark lies from where the point nearest to all its rays is seen, (k,)."""
    frames = np.array([i for i, _, _ in control.observations], dtype=np.intp)
    marks_px = np.array([at[1:] for at in _enlarged(control, scale)])
    at_m = intersection_of_rays(poses, tuple(cameras), frames, marks_px)
    seen = np.array([poses[i].image_from_ground(cameras[i], at_m) for i in frames])
    worst = np.array([max(cameras[i].width_px, cameras[i].height_px) for i in frames], dtype=np.float64)
    miss = np.linalg.norm(seen - marks_px, axis=1)
    return np.where(np.isfinite(miss), np.minimum(miss, worst), worst)
