"""Bundle adjustment: poses, lenses and ground points at once, with GNSS and IMU as weighted observations."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from geomosaic.adjustment.kernels.interior import READOUT, with_interior
from geomosaic.adjustment.kernels.row_functions import with_drift, with_rotation_terms
from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.solver.single_points import clearances_m
from geomosaic.adjustment.solver.solution import (
    Solution,
    Start,
    deviations,
    stated_accuracy,
    undetermined,
    with_unreported_readouts,
)
from geomosaic.adjustment.solver.steps import (
    SolveState,
    converged,
    first_steps,
    iterate,
    with_components,
    with_fixed,
)
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.adjustment.terms.interior_orientation import implausible_interior
from geomosaic.adjustment.terms.rolling_shutter_rotation import RollingShutterRotation
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Bools
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.robust import student_weight
from geomosaic.matching.tracks import frame_by_frame

Found = TypeVar("Found", bound=Start)

_MOST_LEFT_OUT = tuned(0.5, "share of the frames", "more are left out: what is left is half a survey")


@dataclass(frozen=True)
class SolveOptions:
    """How to solve. rough: to compare models by, in half the time. last: no other solve goes on from this
    one; else it ends once variance components have converged. self_calibration: shared unknowns are solved
    for. same_model: the start is of this model of lens and shutter. near: it is a solution by fewer tie
    points: one step leads to other variance components, and rotation that vanishes is not solved for."""

    rough: bool = False
    last: bool = True
    self_calibration: bool = True
    same_model: bool = True
    near: bool = False


def solve(
    problem: BlockProblem, poses: Poses, start: Start | None = None, options: SolveOptions | None = None
) -> Solution:
    """Scoring on the reduced normal equations, Student's distribution of image errors, variance components.

    Minimises the cost of `BlockProblem`. After every convergence the variance components are estimated anew,
    which corrects wrongly stated deviations. Frames at which the system breaks down are left out and tried
    again once all others are solved.

    Args: poses: initial ones; start: an earlier solution whose lenses, points and variance components to go
    on from. Raises: NotSolvableError if more than half of the frames would have to be left out.
    """
    options = options or SolveOptions()
    last = options.last and not options.rough

    def with_covariances(its: _Solved) -> Solution:
        found = _at_last(its.progress) if last else _finished(its.progress)
        return replace(found, implausible=its.implausible, fixed=its.fixed)

    return _without_broken(problem, poses, start, options, with_covariances)


def solved_start(problem: BlockProblem, poses: Poses, start: Start | None, options: SolveOptions) -> Start:
    """`solve` for what another solve goes on from, without covariances."""
    return _without_broken(problem, poses, start, options, lambda its: its.start)


@dataclass(frozen=True)
class _Solved:
    """A solve that has converged; which shared unknowns (s,) are implausible, and which are fixed."""

    progress: SolveState
    implausible: Bools
    fixed: Bools

    @property
    def start(self) -> Start:
        """Without covariances."""
        problem, at, components = self.progress.problem, self.progress.at, self.progress.components
        poses, cameras = _poses(problem, at), _cameras(problem, at)
        return Start(poses, cameras, at, components, self.fixed, problem.image.local)


def _without_broken(
    problem: BlockProblem,
    poses: Poses,
    start: Start | None,
    options: SolveOptions,
    finish: Callable[[_Solved], Found],
) -> Found:
    """The solution without frames at which the system breaks down, which are tried again at last."""
    left_out = np.zeros(len(poses), dtype=bool)
    while True:
        try:
            found = finish(_solved(problem, poses, start, options, left_out))
            break
        except NotSolvableError as error:
            weak = [i for i in error.frames if not left_out[i]]
            if not weak or left_out.sum() + len(weak) > _MOST_LEFT_OUT * len(poses):
                raise
            left_out[weak] = True
    if left_out.any():
        options = replace(options, same_model=True)
        with suppress(NotSolvableError):
            return finish(_solved(problem, found.poses, found, options, np.zeros_like(left_out)))
    return found


def _solved(
    problem: BlockProblem, poses: Poses, start: Start | None, options: SolveOptions, left_out: Bools
) -> _Solved:
    """The solution with all unknowns that the block determines."""
    at, fixed = _first_estimate(problem, poses, start)
    problem = problem.without(left_out, at)
    image_converged = start is not None and options.same_model and _of_its_functions(problem, start)
    components = start.components if start is not None and image_converged else _first_components(problem, at)
    if start is None:
        fixed = at.layout.optional & (not options.self_calibration)
    elif start.local is not None:
        problem = replace(problem, image=replace(problem.image, local=start.local))
    problem = replace(problem, clearance_m=clearances_m(problem.tracks, at.positions_m, at.points_m))
    implausible, may_free = np.zeros_like(fixed), start is not None and options.self_calibration
    progress = SolveState(problem, at, components)
    while True:
        progress = with_fixed(replace(progress, problem=replace(progress.problem, fixed=fixed)))
        progress = iterate(progress, rough=True, image_converged=image_converged, near=options.near)
        problem, at = progress.problem, progress.at
        implausible = implausible | implausible_interior(at, problem.cameras)
        more = implausible | undetermined(problem, at, progress.components)
        more = more if may_free else fixed | more
        if np.array_equal(more, fixed):
            break
        fixed, may_free = more, False
    if not options.rough:
        progress = iterate(progress, rough=False, image_converged=True, near=options.near)
    return _Solved(progress, implausible, fixed)


def _at_last(progress: SolveState) -> Solution:
    """The solution once nothing moves any more."""
    progress = converged(progress)
    problem, scores = with_unreported_readouts(progress.problem, progress.at, progress.components)
    at = replace(progress.at, layout=problem.layout)
    return replace(_finished(replace(progress, problem=problem, at=at)), readout_score=scores)


def last_steps(begun: Solution) -> Solution:
    """The fully converged solution from one of a solve that was not the `last`. Raises: NotSolvableError."""
    solved = _at_last(SolveState(begun.problem, begun.estimate, begun.components))
    return replace(solved, implausible=begun.implausible, fixed=begun.fixed)


def converged_solution(problem: BlockProblem, start: Start) -> Solution:
    """The solution with the variance components and fixed unknowns of a start. Raises: NotSolvableError."""
    solved = _at_last(SolveState(replace(problem, fixed=start.fixed), start.estimate, start.components))
    return replace(solved, fixed=start.fixed)


def few_steps(problem: BlockProblem, start: Start) -> Start:
    """A few steps from a solution of another model, the first of them that of a score test (Rao 1948).
    Residuals weigh by their present median and priors as stated; then variance components are estimated once.
    Raises: NotSolvableError where the equations have no solution."""
    at, fixed = _first_estimate(problem, start.poses, start)
    components = _first_components(problem, at)
    as_before = components.also({IMAGE: start.components[IMAGE]})
    fixed = fixed & undetermined(problem, at, as_before)
    problem = replace(problem, fixed=fixed)
    progress = with_components(SolveState(problem.reweighted(at, components), at, components))
    unknown = np.zeros_like(fixed)
    return replace(_Solved(first_steps(progress), unknown, fixed).start, local=None)


def _first_estimate(problem: BlockProblem, poses: Poses, start: Start | None) -> tuple[Estimate, Bools]:
    """The initial estimate, and which shared unknowns are fixed."""
    layout, frames = problem.layout, len(poses)
    shared, fixed = layout.given.copy(), np.zeros(layout.size, dtype=bool)
    points_m = problem.points.given_m
    if start is not None:
        (shared, fixed), points_m = start.shared_in(layout), start.points_m
    terms = next((t.terms for t in problem.frames if isinstance(t, RollingShutterRotation)), 0)
    rotation_terms_rad, drift = np.zeros((frames, terms, 3)), np.zeros((frames, 3))
    if start is not None and terms:
        same = min(terms, start.estimate.rotation_terms_rad.shape[1])
        rotation_terms_rad[:, :same], drift = (
            start.estimate.rotation_terms_rad[:, :same],
            start.estimate.drift,
        )
    positions_m, rotations = poses.positions_m.copy(), poses.rotations.copy()
    return Estimate(layout, positions_m, rotations, points_m, shared, rotation_terms_rad, drift), fixed


def _of_its_functions(problem: BlockProblem, start: Start) -> bool:
    """Whether a solution has estimated the components of all functions of the frames' rotation, those it left
    out too."""
    term = next((t for t in problem.frames if isinstance(t, RollingShutterRotation)), None)
    names, terms = (set(), 0) if term is None else (set(term.component_names()), term.terms)
    return names <= set(start.components.values) and start.estimate.rotation_terms_rad.shape[1] <= terms


def _first_components(problem: BlockProblem, at: Estimate) -> Components:
    """Image coordinates count by their present median residual, all else as stated."""
    ones = {name: 1.0 for term in problem.terms for name in term.component_names()}
    return Components(ones | problem.image.first_components(at))


def _finished(progress: SolveState) -> Solution:
    """The solution with its covariances."""
    problem, at, components = progress.problem, progress.at, progress.components
    image, stated = problem.image, stated_accuracy(problem, at, components)
    standardised = image.standardised(at, components)
    weight = np.nan_to_num(student_weight(standardised) / student_weight(np.zeros(1)))
    # what a frame's points share is no noise of each of them
    points_m2 = np.diagonal(stated.reduced.points_inverse, axis1=1, axis2=2) / image.design_effect
    return Solution(
        poses=stated.of(_poses(problem, at)),
        cameras=_cameras(problem, at),
        estimate=at,
        components=components,
        fixed=np.zeros(at.layout.size, dtype=bool) if problem.fixed is None else problem.fixed,
        local=image.local,
        problem=problem,
        points_sd_m=deviations(points_m2, problem.points.sd_m),
        stated=stated,
        implausible=np.zeros(at.layout.size, dtype=bool),
        residual_px=image.tracks.image_px - image.computed_px(at),
        weight=weight * image.used,
        left_out=image.left_out,
        readout_score=np.zeros(len(image.cameras)),
        steps=progress.steps,
    )


def _cameras(problem: BlockProblem, at: Estimate) -> tuple[Camera, ...]:
    return tuple(with_interior(c, row) for c, row in zip(problem.cameras, at.interior, strict=True))


def _poses(problem: BlockProblem, at: Estimate) -> Poses:
    """The estimated poses, whose turns and velocities include rotation and drift while rows are read."""
    poses = replace(problem.image.reported, positions_m=at.positions_m, rotations=at.rotations)
    if not at.rotation_terms_rad.shape[1]:
        return poses
    readouts_s = at.interior[problem.image.camera_of, READOUT]
    drift_m, tracks = np.zeros(at.drift.shape), problem.image.tracks
    for i, mine in frame_by_frame(tracks.frame):
        away_m = at.points_m[tracks.point[mine]] - at.positions_m[i]
        drift_m[i] = -float(np.median(away_m @ at.rotations[i, :, 2])) * at.drift[i]
    return with_drift(with_rotation_terms(poses, at.rotation_terms_rad, readouts_s), drift_m, readouts_s)
