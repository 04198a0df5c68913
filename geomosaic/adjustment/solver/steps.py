"""Steps of a solve, until unknowns, robust weights and variance components have converged."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.kernels.reduced_equations import Reduced, reduce_normals
from geomosaic.adjustment.model import SolveStep
from geomosaic.adjustment.problem.estimate import Estimate, Step
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.solver.single_points import converged_points, too_near, wandering
from geomosaic.adjustment.solver.variance_components import local_factors, variance_components
from geomosaic.adjustment.terms.gnss_positions import GnssPositions
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.adjustment.terms.rolling_shutter_rotation import RollingShutterRotation
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.robust import share_down_weighted


@dataclass(frozen=True)
class _Stop:
    """A step is the last if it moves no frame by more than `move` of its position's deviation. It must also
    gain no more than `gain` of the cost, or leave no more than `left` deviations (`_left`). The gain alone
    hides a scale that is still off in a large block. Points are brought within `point` of their
    deviations."""

    gain: float
    move: float
    left: float
    point: float


_ROUGH = tuned(_Stop(1e-3, 0.3, 0.0, 0.1), "shares, deviations", "more: components before lenses iterate")
_FINE = tuned(_Stop(1e-7, 0.01, 0.1, 0.01), "shares, deviations", "a tenth of a deviation is left at most")
_FIRST = tuned(_Stop(1e-3, np.inf, 0.0, 0.1), "shares, deviations", "of steps that test a model: no damping")
_FIRST_STEPS = tuned(4, "steps", "of a test, before and after variance components; fewer lose far models")
_SHORTER = tuned(0.8, "times the step before", "a step's length, of slow blocks; where none came before")
_STANDS = tuned(0.03, "share of a variance component", "a dozen frames know it to a third")
_ROUGHLY = tuned(0.15, "share of a variance component", "the same, well enough to compare models")
_STEPS_BETWEEN = tuned(2, "steps", "between estimates of the variance components")
_MOST_STEPS = tuned(30, "steps", "of a block that begins anywhere: those that converge take 5 to 15")
_ROUNDS = tuned(12, "rounds", "of variance components: those that converge take 2 to 6")
_DAMPING = tuned(1e-9, "share of the diagonal", "more: it holds up place, turn and scale of the whole block")
_MOST_DAMPING = tuned(1e6, "share of the diagonal", "steps are next to none: the system is broken")
_SHARES = tuned((1.0, 0.5, 0.25, 0.1), "of a step", "tried before damping where the whole raises the cost")


@dataclass(frozen=True)
class SolveState:
    """A solve on its way: the problem with its present robust weights, estimate, components, past steps."""

    problem: BlockProblem
    at: Estimate
    components: Components
    steps: tuple[SolveStep, ...] = ()

    @property
    def cost(self) -> float:
        return self.problem.cost(self.at, self.components)


def with_fixed(progress: SolveState) -> SolveState:
    """Fixed unknowns at their prior values; the others follow to first order, where that lowers the cost."""
    problem, at = progress.problem, progress.at
    known = problem.known(at.layout)
    off = np.where(known, at.layout.given - at.shared, 0.0)
    if not off.any():
        return progress
    alone = replace(progress, at=replace(at, shared=at.shared + off))
    with suppress(NotSolvableError):
        normals = problem.normals(at, progress.components)
        _, step = _step_of(problem, at, reduce_normals(normals))
        gone = _cleared(problem, at, at.stepped(step))
        shared = np.where(known, alone.at.shared, gone.shared)
        together = replace(progress, at=replace(gone, shared=shared))
        if together.cost < alone.cost:
            return together
    return alone


def iterate(progress: SolveState, *, rough: bool, image_converged: bool, near: bool = False) -> SolveState:
    """Iterates until unknowns, robust weights and variance components have converged. image_converged: the
    image's component is taken as converged. near: see `SolveOptions`."""
    for k in range(_ROUNDS):
        problem = progress.problem.reweighted(progress.at, progress.components)
        most = (1 if near else _STEPS_BETWEEN) if k else _MOST_STEPS
        progress, reduced = _converge(replace(progress, problem=problem), most, _ROUGH)
        problem, at = progress.problem, progress.at
        if image_converged:
            image = problem.image
            counts = ~image.by_hand & image.used
            local = local_factors(image.tracks, at.points_m, image.lengths_px(at), counts)
            problem = replace(problem, image=replace(image, local=local))
        components, image_change, other_change = variance_components(
            problem, at, progress.components, reduced, image_only=not image_converged
        )
        del reduced  # the next ones take as much
        progress = replace(progress, problem=problem, components=components)
        progress = _without_vanished(progress) if near else progress
        if image_converged and max(image_change, other_change) < (_ROUGHLY if rough else _STANDS):
            break
        image_converged = image_change < 0.1
    return progress


def _without_vanished(progress: SolveState) -> SolveState:
    """Without the functions of the frames' rotation that have no share in it any more."""
    frames = tuple(
        t.without_vanished(progress.components) if isinstance(t, RollingShutterRotation) else t
        for t in progress.problem.frames
    )
    terms = next((t.terms for t in frames if isinstance(t, RollingShutterRotation)), 0)
    if terms == progress.at.rotation_terms_rad.shape[1]:
        return progress
    at = replace(progress.at, rotation_terms_rad=progress.at.rotation_terms_rad[:, :terms])
    return replace(progress, problem=replace(progress.problem, frames=frames), at=at)


def converged(progress: SolveState) -> SolveState:
    """Iterates with these robust weights and variance components until nothing moves any more."""
    return _converge(progress, _MOST_STEPS, _FINE)[0]


def first_steps(progress: SolveState) -> SolveState:
    """A few undamped steps, until they gain a thousandth of the cost."""
    return _converge(progress, _FIRST_STEPS, _FIRST)[0]


def with_components(progress: SolveState) -> SolveState:
    """After a few steps, with all variance components by the residuals then."""
    progress, reduced = _converge(progress, _FIRST_STEPS, _FIRST)
    problem, at = progress.problem, progress.at
    components, *_ = variance_components(problem, at, progress.components, reduced, image_only=False)
    return replace(progress, components=components)


def _converge(progress: SolveState, most: int, stop: _Stop) -> tuple[SolveState, Reduced]:
    """Steps until `stop`, or `most`; and the last step's equations without damping."""
    problem, components = progress.problem, progress.components
    sd_m = next(t for t in problem.frames if isinstance(t, GnssPositions)).sd(components)
    at, damping, cost, length = progress.at, 0.0, progress.cost, np.inf
    steps: list[SolveStep] = []
    while True:
        terrain = problem.terrain and problem.terrain.weighed(at)
        if terrain is not problem.terrain:
            problem = replace(problem, terrain=terrain)
            cost = problem.cost(at, components)
        normals = problem.normals(at, components)
        gain, moved, step_m = 0.0, 0.0, 0.0
        while True:
            try:
                reduced = reduce_normals(normals, damping)
                reduced, step = _step_of(problem, at, reduced)
            except NotSolvableError:
                if damping > _MOST_DAMPING:
                    raise
                damping = max(10.0 * damping, _DAMPING)
                continue
            whole = damping == 0.0
            alone = wandering(reduced, stop.point) if whole else np.zeros(0, np.intp)
            for share in _SHARES if whole else _SHARES[:1]:
                trial = converged_points(problem, at.stepped(step, share), components, alone, stop.point)
                trial = _cleared(problem, at, trial)
                trial_cost = problem.cost(trial, components)
                if trial_cost < cost:
                    break
            if trial_cost < cost or damping > _MOST_DAMPING or _share_moved(step, sd_m) < stop.move:
                break
            damping = max(10.0 * damping, _DAMPING)
        if trial_cost < cost:
            gain, moved = cost - trial_cost, _share_moved(step, sd_m)
            step_m = float(np.linalg.norm(trial.positions_m - at.positions_m, axis=1).max())
            at, cost = trial, trial_cost
        down = _down_weighted(problem, at, components)
        steps.append(SolveStep("", cost, components[IMAGE], damping, step_m, down))
        before, length = length, _length(reduced, step)
        little = gain <= stop.gain * max(cost, 1.0) or _left(length, before) <= stop.left
        if len(steps) >= most or (little and moved <= stop.move):
            progress = replace(progress, problem=problem, at=at, steps=(*progress.steps, *steps))
            return progress, reduced if damping == 0.0 else reduce_normals(normals)
        damping = damping / 10.0 if damping > 10.0 * _DAMPING else 0.0
        del normals, reduced  # the next ones take as much


def _step_of(problem: BlockProblem, at: Estimate, reduced: Reduced) -> tuple[Reduced, Step]:
    """The equations with all that depends on the step, and their solution; known and fixed numbers stay."""
    known = problem.known(at.layout)

    def solution(equations: Reduced) -> Step:
        pose, interior, points, level, platform = equations.solve()
        shared = np.concatenate([interior.ravel(), [level], platform])
        return Step(pose, points, np.where(known, 0.0, shared))

    if problem.terrain is None:
        return reduced, solution(reduced)
    return problem.terrain.solved(reduced, at, solution)


def _length(reduced: Reduced, step: Step) -> float:
    """Of a step, in deviations of the solution: no unknown, nor any sum of them, moves by more."""
    square = float(reduced.pose_side @ step.pose.ravel() + reduced.shared_side @ step.shared)
    return float(np.sqrt(max(square, 0.0)))


def _left(length: float, before: float) -> float:
    """What all later steps come to, in deviations, if each is as much shorter as this is than that before."""
    shorter = length / before if 0.0 < before < np.inf else _SHORTER
    return length * shorter / (1.0 - shorter) if shorter < 1.0 else np.inf


def _down_weighted(problem: BlockProblem, at: Estimate, components: Components) -> float:
    """The share of the image observations that count for less than half."""
    length = problem.image.standardised(at, components)[problem.image.used]
    return share_down_weighted(np.nan_to_num(length, nan=np.inf))


def _cleared(problem: BlockProblem, before: Estimate, after: Estimate) -> Estimate:
    """The estimate after a step, but points that would come too near to a camera stay where they were."""
    if problem.clearance_m is None:
        return after
    near = too_near(problem.tracks, problem.clearance_m, after.positions_m, after.points_m)
    if not len(near):
        return after
    points = after.points_m.copy()
    points[near] = before.points_m[near]
    return replace(after, points_m=points)


def _share_moved(step: Step, sd_m: Floats) -> float:
    """The largest move of a frame, as a share of its position's deviation."""
    return float((np.abs(step.pose[:, :3]) / sd_m).max())
