"""What any method's poses mean for the block: status and residuals."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.control import Spread, control_residuals, control_warnings
from geomosaic.adjustment.misalignment import ties_on_ground
from geomosaic.adjustment.model import Adjusted, Block, Round
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import Warn

Floats = NDArray[np.float64]


def residuals_m(
    block: Block, poses: Poses, cameras: tuple[Camera, ...], ground: GroundSurface
) -> tuple[Floats, ...]:
    """Per pair (k, 2): right minus left on the ground, east and north; NaN where a ray misses."""
    on_ground = ties_on_ground(block, poses, cameras, ground)
    return tuple(right[:, :2] - left[:, :2] for left, right in on_ground)


def settled(
    block: Block,
    poses: Poses,
    rounds: tuple[Round, ...],
    *,
    cameras: tuple[Camera, ...] | None = None,
    ground: GroundSurface | None = None,
    warnings: tuple[Warn, ...] = (),
    figures: dict[str, float] | None = None,
    spread: Spread | None = None,
    unsolved: Collection[int] = (),
) -> Adjusted:
    """The outcome for poses found by any method: `tied` are frames with tie points, the others are
    `placed` by POS alone, as are those `unsolved`. spread: see `control_residuals`; given by methods that
    used control."""
    cameras, ground = cameras or block.cameras, ground or block.ground
    tied = {i for tie in block.ties.pairs for i in (tie.left, tie.right)} - set(unsolved)
    control = control_residuals(block, poses, cameras, ground, spread)
    return Adjusted(
        poses=poses,
        cameras=cameras,
        status=tuple("tied" if i in tied else "placed" for i in range(len(block.names))),
        rounds=rounds,
        residuals_m=residuals_m(block, poses, cameras, ground),
        ground=ground,
        warnings=(*warnings, *control_warnings(control)),
        figures=figures or {},
        control=control,
    )
