"""The changed part of a block solved between earlier poses, which stay: only the new work.

A whole adjustment moves every frame a little for each new one. Where that is less than a stated bound, the
frames whose tie points changed are solved alone. Lenses and variance components are those of before.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Final

import numpy as np

from geomosaic.adjustment.ground.ground_choice import flying_height_m, off_ground_m, surface_of
from geomosaic.adjustment.model import Adjusted, Block
from geomosaic.adjustment.paper.misalignment import offset_net
from geomosaic.adjustment.procedure.block_problem import (
    block_problem,
    near_ground,
    part_of_frames,
    with_offset,
)
from geomosaic.adjustment.procedure.block_solution import points_on_ground
from geomosaic.adjustment.procedure.blunder_detection import contradicted_frames, counted_shares
from geomosaic.adjustment.procedure.changed_part import (
    SHIFT,
    ChangedPart,
    EarlierBlock,
    by_known_flights,
    changed_frames,
    moved_m,
    tied_with,
    whole_block_shift_m,
)
from geomosaic.adjustment.procedure.common_offsets import flights_error_sd_m
from geomosaic.adjustment.procedure.earlier_motion import (
    with_earlier_turns,
    with_earlier_velocities,
    with_motion_of_before,
)
from geomosaic.adjustment.procedure.earlier_solution import start_from_earlier, with_earlier_poses
from geomosaic.adjustment.procedure.initialisation import start_poses
from geomosaic.adjustment.procedure.merged_blocks import SolvedPart, merged, merged_surface
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.solver.solve import converged_solution
from geomosaic.adjustment.solver.variance_components import local_factors
from geomosaic.adjustment.terms.gnss_positions import OFFSET
from geomosaic.arrays import Bools, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.matching.tracks import Tracks, join_tracks, nearest_to_rays, thin_tracks
from geomosaic.placement.prior import position_assumed
from geomosaic.projection.ground import GroundSurface

CHANGED: Final = "the changed part"
"""What the solve of it is called."""


def adjusted_in_part(block: Block, earlier: EarlierBlock) -> Adjusted | None:
    """The block with the earlier poses, but for frames whose tie points changed. As many about them are
    solved as move by more than the bound, and by more than an image point is known to.

    None where a whole adjustment is needed. That is where corrected positions would move the earlier frames
    by more than the bound. It is also where all positions would move them by more than the map's place is
    known to, in this run and those before together. The same holds where new images fit the earlier lenses
    badly, or a DEM is another one or shows more land. Control points, gyroscopes and unknowns of the platform
    tie all frames together."""
    if earlier.solved is None or _ties_all(block, earlier):
        return None
    if block.ground.kind == "dem" and not _alike(block.ground, earlier.prior_ground):
        return None
    was, changed = changed_frames(block, earlier)
    if position_assumed(block.poses)[was < 0].any():
        return None
    image_sd_px = earlier.adjusted.figures.get("sigma_px", 0.0)
    most_m = max(earlier.bound_m, image_sd_px * block.ground_pixel_m)
    with suppress(NotSolvableError):
        while changed.any():
            frames = np.flatnonzero(tied_with(block, changed))
            part = ChangedPart(was, frames, changed[frames])
            if 2 * int(part.free.sum()) > len(block.names):
                return None
            found = _adjusted(block, part, earlier)
            if found is None:
                return None
            at = found.poses, was
            shift_m = earlier.shift_m + whole_block_shift_m(block, at, earlier)
            corrected_m = whole_block_shift_m(block, at, earlier, corrected=True)
            if shift_m > earlier.datum_sd_m or corrected_m > earlier.bound_m:
                return None
            known = np.flatnonzero(changed & (was >= 0))
            moved = known[moved_m(found, (earlier.adjusted.poses, was), known) > most_m]
            grown = np.isin(np.arange(len(was)), moved)
            grown = changed | tied_with(block, grown)
            if (grown == changed).all():
                return replace(found, figures=found.figures | {SHIFT: shift_m})
            changed = grown
        none = np.zeros(0, dtype=np.intp)
        return merged(block, earlier, ChangedPart(was, none, none.astype(bool)), None)
    return None


def kept_poses(found: Adjusted, earlier: EarlierBlock) -> Bools:
    """Which frames (n,) have the very position of one in the earlier block."""
    before = {position.tobytes() for position in earlier.adjusted.poses.positions_m}
    return np.array([position.tobytes() in before for position in found.poses.positions_m], dtype=bool)


def _alike(one: GroundSurface, other: GroundSurface) -> bool:
    """Whether two grounds have the same nodes and heights."""
    lies = [(g.kind, g.east_0_m, g.north_0_m, g.spacing_m) for g in (one, other)]
    return lies[0] == lies[1] and np.array_equal(one.up_m, other.up_m, equal_nan=True)


def _ties_all(block: Block, earlier: EarlierBlock) -> bool:
    """Whether something joins all frames that a part does not show."""
    adjusted, solved = earlier.adjusted, earlier.solved
    assert solved is not None
    known = {camera.name for camera in adjusted.cameras}
    settings = solved.settings
    turned = any(block.turned) or block.poses.turns is not None
    platform = settings.boresight or settings.lever_arm or settings.gps_lag
    unlike = not known.issuperset(camera.name for camera in block.cameras)
    return bool(block.control or turned or platform or unlike or adjusted.control)


def _adjusted(block: Block, changed: ChangedPart, earlier: EarlierBlock) -> Adjusted | None:
    """The block with the part solved; None where its images fit the earlier lenses badly."""
    solved, adjusted = earlier.solved, earlier.adjusted
    assert solved is not None
    lenses = {c.name: c for c in adjusted.cameras}
    block_now = by_known_flights(block, changed.was, earlier)
    part = replace(
        changed.of(with_earlier_velocities(block_now, changed.was, adjusted.poses)),
        cameras=tuple(lenses[block.cameras[i].name] for i in changed.frames),
    )
    if adjusted.ground.kind != "tie_surface":
        part = replace(part, ground=adjusted.ground)
    was = changed.was[changed.frames]
    poses = with_earlier_poses(start_poses(part, offset_net(part)), solved, part, was >= 0)
    sizes = np.array([[c.width_px, c.height_px] for c in part.cameras])
    tracks = thin_tracks(join_tracks(part.ties), sizes, solved.settings.observations_per_frame)
    if not tracks.points:
        return None
    kept = _kept(part, poses, changed.free, earlier.bound_m)
    solution, ties = _solution(kept, (poses, was), tracks, earlier)
    shares = counted_shares(ties, solution, len(part.names))
    wrong = contradicted_frames(part, solution.poses, shares)
    if (shares[changed.free] < 0.5).any() or any(changed.free[i] for i in wrong):
        return None
    ground = adjusted.ground
    if ground.kind == "tie_surface":
        ground = merged_surface(ground, surface_of(part, part.ground, solution)[0])
    earlier = replace(earlier, adjusted=replace(adjusted, ground=ground))
    return merged(block, earlier, changed, SolvedPart(part, ties, solution))


def _kept(part: Block, poses: Poses, free: Bools, bound_m: float) -> Block:
    """The part whose frames that are not solved are reported where they are, so that they move by no more
    than the bound."""
    given, kept, sd_m = part.poses, ~free[:, None], bound_m / THREE_SIGMA
    reported = replace(
        given,
        positions_m=np.where(kept, poses.positions_m, given.positions_m),
        rotations=np.where(kept[:, :, None], poses.rotations, given.rotations),
        positions_sd_m=np.where(kept, sd_m, given.positions_sd_m),
        rotations_sd_rad=np.where(kept, sd_m / flying_height_m(part), given.rotations_sd_rad),
    )
    return replace(part, poses=reported)


def _solution(
    part: Block, begun: tuple[Poses, Ints], tracks: Tracks, earlier: EarlierBlock
) -> tuple[Solution, Tracks]:
    """The part solved with free points, then bound to the ground if the block lies on one; and its tracks.
    Lenses are known, and so is how earlier frames turned while they were read. begun: initial poses, and the
    frames' numbers in the earlier block. Raises: NotSolvableError."""
    (poses, was), solved = begun, earlier.solved
    assert solved is not None
    points, ties = points_on_ground(poses, part.cameras, part.ground, tracks)
    points = nearest_to_rays(ties, poses, part.cameras, points)
    problem = block_problem(part, solved.settings, ties, points)
    known = tuple(replace(u, sd=np.zeros_like(u.sd)) for u in problem.interior)
    effect = earlier.adjusted.figures.get("design_effect", 1.0)
    image = replace(problem.image, design_effect=effect)
    problem = replace(problem, interior=known, image=image)
    problem = with_earlier_turns(problem, was, (earlier.adjusted.poses, solved))
    new_flights = bool(part.flight_of.any())
    if new_flights:
        problem = with_offset(problem, flights_error_sd_m(part.poses) * [1.0, 1.0, 0.0])
    solved = replace(solved, cameras=earlier.adjusted.cameras)
    start = start_from_earlier(part, solved, ties, poses)
    estimate = replace(start.estimate, layout=problem.layout, shared=problem.layout.given, points_m=points)
    fixed = np.zeros(problem.layout.size, dtype=bool)
    if new_flights:  # the kept frames are where they are
        fixed[problem.layout.slices[OFFSET]] = np.arange(3 * (1 + part.flight_of.max())) < 3
    start = replace(start, estimate=estimate, fixed=fixed)
    found = converged_solution(problem, start)
    problem, ground = found.problem, earlier.adjusted.ground
    if ground.kind != "tie_surface":
        off_m = off_ground_m(part, ground, found, part_of_frames(part)[ties.frame[_first(ties)]])
        near = near_ground(part, problem, off_m)
        problem = replace(problem, terrain=near)
    found = converged_solution(_weighed(problem, found), found)
    return with_motion_of_before(found, part.names, solved), ties


def _weighed(problem: BlockProblem, found: Solution) -> BlockProblem:
    """The problem with the weights that the residuals of a solution have."""
    image, at = problem.image, found.estimate
    local = local_factors(image.tracks, at.points_m, image.lengths_px(at), image.used)
    return replace(problem, image=replace(image, local=local)).reweighted(at, found.components)


def _first(ties: Tracks) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """The first observation of each point, (p,)."""
    return np.unique(ties.point, return_index=True)[1]
