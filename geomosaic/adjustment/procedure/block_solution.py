"""A block solved with free points, then with control, then bound to the ground if its points lie on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.ground.ground_choice import (
    LEAST_POINTS,
    chosen_ground,
    levelled,
    lies_flat,
    off_ground_m,
    surface_and_relief,
)
from geomosaic.adjustment.model import Block, Settings, SolveStep
from geomosaic.adjustment.procedure.block_problem import (
    block_problem,
    near_ground,
    part_of_frames,
    with_control,
    with_offset,
)
from geomosaic.adjustment.procedure.common_offsets import (
    common_error,
    flights_error_sd_m,
    stated_sd_m,
)
from geomosaic.adjustment.procedure.control_points import control_residuals
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.solver.single_points import clearances_m, too_near
from geomosaic.adjustment.solver.solution import Solution, Start
from geomosaic.adjustment.solver.solve import SolveOptions, last_steps, solve
from geomosaic.adjustment.terms.gnss_positions import GnssPositions
from geomosaic.adjustment.terms.terrain import Terrain
from geomosaic.arrays import Bools, Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import NORMAL_PER_MAD
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.matching.tracks import Tracks, chosen_tracks, nearest_to_rays
from geomosaic.projection.footprint import ground_from_images
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.accuracy import POSITION


@dataclass(frozen=True)
class BlockSolution:
    """Tie points, the problem that was solved (with control points last), its solution, and the ground.
    offset (3,): axes along which control points show what all positions are off by in common. relief_px: see
    `chosen_ground`, of a surface taken after flat ground failed. steps: of all solves that led here. houses:
    share of the land under tall houses, which the ground lacks."""

    ties: Tracks
    problem: BlockProblem
    solution: Solution
    ground: GroundSurface
    relief_px: float
    offset: Bools
    steps: tuple[SolveStep, ...] = ()
    houses: float = 0.0

    @property
    def of_ties(self) -> Solution:
        """The solution without control points."""
        return _of_ties(self.solution, self.ties)


@dataclass(frozen=True)
class BlockTask:
    """A block to solve by some tracks. rough: another solve by more tracks follows. flights_sd_m (3,):
    deviations of what positions of a flight are off by in common, where an earlier solve found them."""

    block: Block
    settings: Settings
    tracks: Tracks
    rough: bool = False
    flights_sd_m: Floats | None = None


def block_solution(
    task: BlockTask, poses: Poses, start: BlockSolution | Start | None = None
) -> BlockSolution:
    """Free points first, then with control, then bound to the ground if they lie on one; only the last of
    these solves converges fully. Args: poses: initial ones. start: a solution to go on from: of the same
    tracks and lenses, or a solver's, by the same model and other tracks."""
    block, settings, tracks, rough = task.block, task.settings, task.tracks, task.rough
    last = SolveOptions(rough=rough, self_calibration=settings.self_calibration)
    again: Start | None = None
    if isinstance(start, BlockSolution):
        ties, again = start.ties, start.of_ties
        points = start.problem.points.given_m[: ties.points]
    else:
        found = {} if start is None else {c.name: c for c in start.cameras}
        lenses = [found.get(c.name, c) for c in block.cameras]
        points, ties = points_on_ground(poses, lenses, block.ground, tracks)
        if start is not None:
            again = start.of_points(_nearest_to_rays(ties, start.poses, lenses, points))
    problem = block_problem(block, settings, ties, points)
    if task.flights_sd_m is not None:
        problem = with_offset(problem, task.flights_sd_m)
    options = replace(last, last=not ties.points)
    free = solve(problem, poses, again, options) if ties.points else None
    controlled, offset = with_control(problem, block.control), np.zeros(3, dtype=bool)
    if free is not None and controlled is problem:
        controlled, solved = _with_flights(block, problem, free, options)
    else:
        controlled, solved, offset = _with_control(block, controlled, poses, free, options)
    steps = solved.steps if free is None or solved is free else free.steps + solved.steps
    if not ties.points:
        return BlockSolution(ties, controlled, solved, block.ground, float("nan"), offset, steps)
    part = part_of_frames(block)[ties.frame[np.unique(ties.point, return_index=True)[1]]]
    ground, relief_px = chosen_ground(block, settings.ground, _of_ties(solved, ties), ties.lengths, part)
    free_points = BlockSolution(ties, controlled, solved, ground, relief_px, offset, steps)
    if ground.kind == "tie_surface":
        return free_points if rough else _at_last(free_points)
    off_m = off_ground_m(block, ground, _of_ties(solved, ties), part)
    bound_problem = replace(controlled, terrain=near_ground(block, controlled, off_m))
    bound = solve(bound_problem, solved.poses, solved, last)
    steps += bound.steps
    ground = levelled(ground, _of_ties(bound, ties))
    tried = ground.kind == "flat" and settings.ground == "auto" and ties.points >= LEAST_POINTS
    if tried and not lies_flat(block, ground, _of_ties(solved, ties), _of_ties(bound, ties)):
        surface, relief_px = surface_and_relief(block, ground, _of_ties(solved, ties))
        free_points = replace(free_points, ground=surface, relief_px=relief_px, steps=steps)
        return free_points if rough else _at_last(free_points)
    return BlockSolution(ties, bound_problem, bound, ground, relief_px, offset, steps)


def _at_last(found: BlockSolution) -> BlockSolution:
    """The same once nothing moves any more."""
    solved = last_steps(found.solution)
    return replace(found, solution=solved, steps=found.steps + solved.steps)


def by_all_points(
    block: Block, settings: Settings, tracks: Tracks, few: BlockSolution, design_effect: float
) -> BlockSolution:
    """The solution by all tie points, from that by few, on the same kind of ground; a surface stays."""
    lenses, poses = [few.solution.cameras[k] for k in block.lens_of], few.solution.poses
    points, ties = points_on_ground(poses, lenses, few.ground, tracks)
    surface = few.ground.kind == "tie_surface"
    if surface:
        points = _nearest_to_rays(ties, poses, lenses, points)
    problem = with_control(block_problem(block, settings, ties, points), block.control)
    image = replace(problem.image, reported=few.problem.image.reported, design_effect=design_effect)
    problem = replace(problem, image=image, frames=few.problem.frames)
    if not surface and few.problem.terrain is not None:
        problem = replace(problem, terrain=_on(few.problem.terrain, problem))
    control_m = few.solution.points_m[few.ties.points :]
    again = few.solution.of_points(np.concatenate([points, control_m]))
    again = replace(few.solution, estimate=again.estimate, local=None)
    options = SolveOptions(self_calibration=settings.self_calibration, near=True)
    solved = solve(problem, poses, again, options)
    ground = few.ground if surface else levelled(few.ground, _of_ties(solved, ties))
    return BlockSolution(ties, problem, solved, ground, few.relief_px, few.offset, solved.steps)


def _on(terrain: Terrain, problem: BlockProblem) -> Terrain:
    """The terrain under the points of another problem."""
    return replace(terrain, bound=~problem.points.control, frame_share=problem.image.frame_share())


def _nearest_to_rays(tracks: Tracks, poses: Poses, lenses: Sequence[Camera], ground_m: Floats) -> Floats:
    """`nearest_to_rays`, but those that come too near to a camera begin on the ground."""
    points = nearest_to_rays(tracks, poses, lenses, ground_m)
    clearance_m = clearances_m(tracks, poses.positions_m, ground_m)
    near = too_near(tracks, clearance_m, poses.positions_m, points)
    points[near] = ground_m[near]
    return points


def _shift_to_control(block: Block, poses: Poses, cameras: tuple[Camera, ...]) -> tuple[Floats, Bools]:
    """Median of control minus its place by the poses, (3,), and along which axes (3,) it shows another datum.
    It does where three points or more agree on more than the positions' deviations and the points' scatter
    explain. Heights of points known in plan only, or seen in one image, are the prior ground's and count
    nothing."""
    used = replace(block, control=tuple(c for c in block.control if not c.check), cameras=cameras)
    found = control_residuals(used, poses)
    off = np.array([c.residual_m for c in found]).reshape(-1, 3)
    nowhere_m = POSITION["none"].sd_vertical_m
    off[[c.images < 2 or c.surveyed_sd_m[2] >= nowhere_m for c in found], 2] = np.nan
    shift, datum = np.zeros(3), np.zeros(3, dtype=bool)
    for axis, sd_m in enumerate(np.median(block.poses.positions_sd_m, axis=0)):
        known = off[np.isfinite(off[:, axis]), axis]
        if len(known):
            shift[axis] = np.median(known)
            scatter_m = NORMAL_PER_MAD * np.median(np.abs(known - shift[axis]))
            of_shift_m = np.sqrt(np.pi / 2.0 / len(known)) * scatter_m  # a median's, of normal errors
            beyond = np.abs(shift[axis]) > THREE_SIGMA * np.hypot(sd_m, of_shift_m)
            datum[axis] = len(known) >= 3 and beyond
    return shift, datum


def _with_control(
    block: Block, problem: BlockProblem, poses: Poses, free: Solution | None, options: SolveOptions
) -> tuple[BlockProblem, Solution, Bools]:
    """The solution with control points, begun from the free one shifted onto them, so that each point is
    compared with the others. Positions have an offset in common, with the deviation of their common error, at
    least as stated, or unbounded where they are of another datum. Otherwise their common error would outweigh
    control and bend the block."""
    lenses, begun = (free.cameras, free.poses) if free else (problem.cameras, poses)
    shift, datum = _shift_to_control(block, begun, tuple(lenses[k] for k in block.lens_of))
    begun = replace(begun, positions_m=begun.positions_m + shift)
    anywhere = POSITION["none"].sd_horizontal_m
    offset_sd_m = np.where(datum.any(), anywhere, np.zeros(3))
    again: Start | None = None
    if free is not None:
        if not datum.any():
            common_m = np.sqrt(common_error(block, free.poses, block.ground, free.components))
            offset_sd_m = np.maximum(common_m, stated_sd_m(block.poses))
        points = np.concatenate([free.points_m + shift, problem.points.given_m[len(free.points_m) :]])
        level = free.estimate.layout.level
        shared = free.estimate.shared + np.eye(free.estimate.layout.size)[level] * shift[2]
        again = replace(free, estimate=replace(free.estimate, points_m=points, shared=shared), local=None)
    problem = with_offset(problem, offset_sd_m)
    return problem, solve(problem, begun, again, options), offset_sd_m > 0.0


def _with_flights(
    block: Block, problem: BlockProblem, free: Solution, options: SolveOptions
) -> tuple[BlockProblem, Solution]:
    """The solution in which the positions of each of several flights are off in plan in common, since a
    receiver's error lasts for a flight. Otherwise two such errors would turn and stretch the block. What all
    flights are off by stays unknown, see `common_error`."""
    if flights_sd_m(problem).any() or not block.flight_of.any():
        return problem, free
    sd_m = flights_error_sd_m(block.poses) * [1.0, 1.0, 0.0]
    if not sd_m.any():
        return problem, free
    problem = with_offset(problem, sd_m)
    return problem, solve(problem, free.poses, free, options)


def flights_sd_m(problem: BlockProblem) -> Floats:
    """Deviations (3,) of the offsets in plan that the flights of a problem have, 0 for one flight."""
    positions = next(t for t in problem.frames if isinstance(t, GnssPositions))
    return np.array(positions.offset_sd_m) * [1.0, 1.0, 0.0] * (positions.flights > 1)


def _of_ties(solved: Solution, ties: Tracks) -> Solution:
    return solved.of_ties(ties.points, len(ties.frame))


def points_on_ground(
    poses: Poses, cameras: Sequence[Camera], ground: GroundSurface, tracks: Tracks
) -> tuple[Floats, Tracks]:
    """Each track's mean place on the ground by the rays that meet it; tracks without any are dropped."""
    at = ground_from_images(tracks.frame, tracks.image_px, poses, cameras, ground)
    hit = np.isfinite(at).all(axis=1)
    hits = np.bincount(tracks.point, hit, tracks.points)
    sums = [np.bincount(tracks.point, column, tracks.points) for column in np.where(hit, at.T, 0.0)]
    met = hits > 0.0
    points = np.stack(sums, axis=1)[met] / hits[met, None]
    return points, tracks if met.all() else chosen_tracks(tracks, met)
