"""What any method's poses mean for the block: status and residuals."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from geomosaic.adjustment.model import Adjusted, Block, Round
from geomosaic.adjustment.paper.misalignment import ties_on_ground
from geomosaic.adjustment.procedure.common_offsets import common_error, with_common_error
from geomosaic.adjustment.procedure.control_points import (
    Solved,
    Spread,
    control_residuals,
    control_warnings,
    spread_of_poses,
)
from geomosaic.adjustment.procedure.untied_frames import moved_with_neighbours
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.prior import position_assumed
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.control import LEAST_POINTS
from geomosaic.survey.model import Warn


def residuals_m(
    block: Block, poses: Poses, cameras: tuple[Camera, ...], ground: GroundSurface
) -> tuple[Floats, ...]:
    """Per pair (k, 2): right minus left on the ground, east and north; NaN where a ray misses."""
    on_ground = ties_on_ground(block, poses, cameras, ground)
    return tuple(right - left for left, right in on_ground)


def unplaced_parts(block: Block) -> list[list[int]]:
    """The connected parts of a block that nothing places: no frame in them has a position, and they see fewer
    than two control points. Where all are such, the largest lies in a frame of its own, and is none of
    these."""
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


@dataclass(frozen=True)
class Findings:
    """What a method found besides poses. cameras, ground: None for those of the block. spread: see
    `control_residuals`; covariance (f, 6, 6): of the poses; both of methods that use control points.
    common_m2 (3,): see `common_error`. unsolved: frames that could not be solved for; rejected: frames whose
    poses are rejected."""

    cameras: tuple[Camera, ...] | None = None
    ground: GroundSurface | None = None
    warnings: tuple[Warn, ...] = ()
    figures: dict[str, float] = field(default_factory=dict)
    spread: Spread | None = None
    covariance: Floats | None = None
    common_m2: Floats | None = None
    unsolved: tuple[int, ...] = ()
    rejected: tuple[int, ...] = ()


def outcome(
    block: Block, poses: Poses, rounds: tuple[Round, ...], findings: Findings | None = None
) -> Adjusted:
    """The outcome for poses found by any method. `tied` are frames with tie points. The others, and those
    unsolved, are `placed` by POS alone and moved with the tied ones around them unless control points fix
    them. Frames of `unplaced_parts` and those rejected are `rejected`."""
    findings = findings or Findings()
    cameras, ground = findings.cameras or block.cameras, findings.ground or block.ground
    tied = {i for pair in block.ties.frames for i in pair} - set(findings.unsolved)
    nowhere = {i for part in unplaced_parts(block) for i in part} | set(findings.rejected)
    status = np.array(
        ["rejected" if i in nowhere else "tied" if i in tied else "placed" for i in range(len(block.names))]
    )
    untied, spread, covariance = status == "placed", findings.spread, findings.covariance
    if spread is not None:
        untied[[i for c in block.control if not c.check for i, _, _ in c.observations]] = False
        untied[list(findings.unsolved)] = True
    poses = moved_with_neighbours(block.poses, poses, status == "tied", untied)
    common_m2 = findings.common_m2
    if common_m2 is None:
        common_m2 = common_error(block, poses, ground)
    if spread is not None and covariance is not None:
        spread = _with_untied(spread, poses, untied)
        sd = np.column_stack([poses.positions_sd_m, poses.rotations_sd_rad])
        covariance = np.where(untied[:, None, None], sd[:, :, None] ** 2 * np.eye(6), covariance)
    if covariance is not None:
        covariance = covariance + np.diag(np.append(common_m2, np.zeros(3)))
    solved = None if spread is None else Solved(spread, common_m2)
    control = control_residuals(block, poses, cameras, ground, solved)
    poses = with_common_error(poses, common_m2)
    return Adjusted(
        poses=poses,
        cameras=cameras,
        status=tuple(status.tolist()),
        rounds=rounds,
        residuals_m=residuals_m(block, poses, cameras, ground),
        ground=ground,
        warnings=(*findings.warnings, *control_warnings(control)),
        figures=findings.figures | {"common_height_sd_m": float(np.sqrt(common_m2[2]))},
        control=control,
        pose_covariance=covariance,
    )


def _with_untied(spread: Spread, poses: Poses, untied: Bools) -> Spread:
    """A spread in which poses that took no part in the solve have their own deviations."""
    alone = spread_of_poses(poses)

    def both(frames: Ints, by_pose: Floats, by_interior: Floats) -> Floats:
        apart = untied[frames][:, None, None]
        solved = spread(frames, np.where(apart, 0.0, by_pose), by_interior)
        return solved + alone(frames, np.where(apart, by_pose, 0.0), by_interior)

    return both
