"""What any method's poses mean for the block: status and residuals."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted, Block, Round
from geomosaic.adjustment.paper.misalignment import ties_on_ground
from geomosaic.adjustment.procedure.common_offsets import common_error, with_common_error
from geomosaic.adjustment.procedure.untied_frames import moved_with_neighbours
from geomosaic.adjustment.terms.control_points import (
    Spread,
    control_residuals,
    control_warnings,
    spread_of_poses,
)
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.prior import position_assumed
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.control import LEAST_POINTS
from geomosaic.survey.model import Warn

Floats = NDArray[np.float64]


def residuals_m(
    block: Block, poses: Poses, cameras: tuple[Camera, ...], ground: GroundSurface
) -> tuple[Floats, ...]:
    """Per pair (k, 2): right minus left on the ground, east and north; NaN where a ray misses."""
    on_ground = ties_on_ground(block, poses, cameras, ground)
    return tuple(right - left for left, right in on_ground)


def unplaced_parts(block: Block) -> list[list[int]]:
    """The connected parts of a block that nothing places: no frame in them has a position, and they see fewer
    than two control points. Where all are such, the largest lies in a frame of its own, and is none of these.
    """
    assumed = position_assumed(block.poses)
    if not assumed.any():
        return []
    parts = connected_parts(len(block.names), block.ties.frames)
    seen = [{i for i, _, _ in c.observations} for c in block.control if not c.check]
    nowhere = [
        part for part in parts
        if assumed[part].all() and sum(not frames.isdisjoint(part) for frames in seen) < LEAST_POINTS
    ]  # fmt: skip
    return nowhere[1:] if len(nowhere) == len(parts) else nowhere


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
    covariance: Floats | None = None,
    common_m2: Floats | None = None,
    unsolved: Collection[int] = (),
    strayed: Collection[int] = (),
) -> Adjusted:
    """The outcome for poses found by any method: `tied` are frames with tie points, the others are
    `placed` by POS alone, as are those `unsolved`, and moved with the tied ones around them unless control
    points that the method used hold them. Frames that nothing places are `rejected`, see `unplaced_parts`,
    and those `strayed`.

    Args: spread: see `control_residuals`; covariance (f, 6, 6): of the poses. Both are given by methods that
        use control. common_m2: see `common_error`.
    """
    cameras, ground = cameras or block.cameras, ground or block.ground
    tied = {i for pair in block.ties.frames for i in pair} - set(unsolved)
    nowhere = {i for part in unplaced_parts(block) for i in part} | set(strayed)
    status = np.array(
        ["rejected" if i in nowhere else "tied" if i in tied else "placed" for i in range(len(block.names))]
    )
    untied = status == "placed"
    if spread is not None:
        untied[[i for c in block.control if not c.check for i, _, _ in c.observations]] = False
        untied[list(unsolved)] = True
    poses = moved_with_neighbours(block.poses, poses, status == "tied", untied)
    if spread is not None and covariance is not None:
        spread = _with_untied(spread, poses, untied)
        sd = np.column_stack([poses.positions_sd_m, poses.rotations_sd_rad])
        covariance = np.where(untied[:, None, None], sd[:, :, None] ** 2 * np.eye(6), covariance)
    if common_m2 is None:
        common_m2 = common_error(block, poses, ground)
    if covariance is not None:
        covariance = covariance + np.diag(np.append(common_m2, np.zeros(3)))
    control = control_residuals(block, poses, cameras, ground, spread, common_m2)
    poses = with_common_error(poses, common_m2)
    return Adjusted(
        poses=poses,
        cameras=cameras,
        status=tuple(status.tolist()),
        rounds=rounds,
        residuals_m=residuals_m(block, poses, cameras, ground),
        ground=ground,
        warnings=(*warnings, *control_warnings(control)),
        figures=(figures or {}) | {"common_height_sd_m": float(np.sqrt(common_m2[2]))},
        control=control,
        pose_covariance=covariance,
    )


def _with_untied(spread: Spread, poses: Poses, untied: NDArray[np.bool_]) -> Spread:
    """A spread in which poses that took no part in the solve have their own deviations."""
    alone = spread_of_poses(poses)

    def both(frames: NDArray[np.intp], by_pose: Floats, by_interior: Floats) -> Floats:
        apart = untied[frames][:, None, None]
        solved = spread(frames, np.where(apart, 0.0, by_pose), by_interior)
        return solved + alone(frames, np.where(apart, by_pose, 0.0), by_interior)

    return both
