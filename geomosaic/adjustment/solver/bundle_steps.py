"""Steps of a bundle, until its unknowns, the trust in its tags and the variance components stand."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import SolveStep
from geomosaic.adjustment.problem.bundle_model import (
    Factors,
    Priors,
    State,
    stepped,
)
from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.solver.bundle_equations import (
    cost_of,
    has_say,
    image_sd_px,
    known,
    lengths_px,
    normals_of,
    pose_sd,
    share_shown,
    shared_miss,
)
from geomosaic.adjustment.solver.clearance import too_near
from geomosaic.adjustment.solver.local_image_variance import unrest
from geomosaic.adjustment.solver.normal_equations import Reduced, reduce_normals
from geomosaic.adjustment.solver.prior_reweighting import trust_in_tags
from geomosaic.adjustment.solver.single_points import settled_points, wandering
from geomosaic.adjustment.solver.variance_component_newton import ahead, image_change
from geomosaic.adjustment.solver.variance_components import variance_components
from geomosaic.adjustment.terms.control_precision import control_say
from geomosaic.constants import sourced, tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.robust import share_down_weighted

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
Step = tuple[Floats, Floats, Floats, float, Floats]


@dataclass(frozen=True)
class _Stop:
    """A step is the last if it moves no frame by more than `move` of its position's deviation, and gains no
    more than `gain` of the cost or is no longer than `step` (`Reduced.length`). By its gain alone a large
    block would stop while its scale is still off, as among 100,000 observations such a gain hides, and others
    would wait for single blunders to wander off while all frames stand still."""

    gain: float
    move: float
    step: float


_ROUGH: _Stop = tuned(
    _Stop(1e-3, 0.3, 0.0),
    "share of the cost, share of a position's deviation, deviations of what is solved",
    "a block that is to be judged, or whose variance components come next: what is left moves no "
    "judgement. With a gain of a hundredth, components were found before lenses had settled, and a block "
    "with rolling shutters ended 0.2 deviations elsewhere",
)
_FINE: _Stop = sourced(
    _Stop(1e-7, 0.01, 0.015),
    "share of the cost, share of a position's deviation, deviations of what is solved",
    "what is left is some hundredths of what anything is good to: points with an image far off make "
    "steps shrink by a tenth at a time, so that steps of 0.02 may leave 0.08",
    "computed of a block of six frames with such points (tests/test_bundle_oracle.py): 0.03 and 0.02 "
    "leave 0.09 and 0.08 of a lens's deviation, 0.015 less than 0.06",
)
_STANDS = tuned(
    0.03,
    "share of a variance component",
    "by which it may still change when it stands: of a dozen frames it is known to a third itself",
)
_ROUGHLY = tuned(0.15, "share of a variance component", "the same, well enough to compare models")
_STEPS_BETWEEN = tuned(
    2,
    "steps",
    "between estimates of the variance components: a block that all but stands needs no more",
)
_MOST_STEPS = tuned(30, "steps", "of a block that begins anywhere: those that settle take 5 to 15")
_DAMPING = tuned(
    1e-9,
    "share of the diagonal",
    "least damping once a step fails: the diagonal holds thousands of sharp image coordinates, so "
    "that even this holds up scale, turn and place of the whole block, which only the positions know",
)
_MOST_DAMPING = tuned(1e6, "share of the diagonal", "steps are next to none with more: the system is broken")
_SHARES: tuple[float, ...] = tuned(
    (1.0, 0.5, 0.25, 0.1),
    "of a step",
    "that are tried before damping if the whole would raise the cost: a part goes the same way, also "
    "for the block as a whole",
)


def with_held(tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors) -> State:
    """What is held is as it was given; all else goes with it to first order, where that is better."""
    off = np.where(known(priors), shared_miss(priors, state), 0.0)
    if not off.any():
        return state
    of_cameras, of_platform = np.split(off, [state.interior.size])
    there = state.interior + of_cameras.reshape(state.interior.shape), state.mounting + of_platform
    alone = replace(state, interior=there[0], mounting=there[1])
    with suppress(NotSolvableError):
        step = reduce_normals(normals_of(tracks, camera_of, priors, state, factors)).solve()
        gone = _kept_away(tracks, priors, state, stepped(state, 1.0, *step))
        stays = known(priors)[: state.interior.size].reshape(state.interior.shape)
        interior = np.where(stays, there[0], gone.interior)
        mounting = np.where(known(priors)[state.interior.size :], there[1], gone.mounting)
        together = replace(gone, interior=interior, mounting=mounting)
        costs = (cost_of(tracks, camera_of, priors, s, factors) for s in (together, alone))
        if next(costs) < next(costs):
            return together
    return alone


def settle(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    state: State,
    factors: Factors,
    *,
    rough: bool,
    settled: bool,
) -> tuple[State, Priors, Factors, tuple[SolveStep, ...]]:
    """Iterates until unknowns, trust and variance components stand; the steps it took. settled: whether the
    image's component is believed to stand already."""
    steps: tuple[SolveStep, ...] = ()
    for _ in range(12):
        say = control_say(tracks, camera_of, priors, state, factors)
        priors = replace(priors, trust=trust_in_tags(priors, state, factors), control_say=say)
        state, used, reduced = _converge(
            *(tracks, camera_of, priors, state, factors),
            *(_STEPS_BETWEEN if steps else _MOST_STEPS, _ROUGH),
        )
        steps += used
        if settled:
            counts = ~priors.control[tracks.point] & has_say(tracks, priors)
            length_px = lengths_px(tracks, camera_of, priors, state)
            priors = replace(priors, unrest=unrest(tracks, state.points, length_px, counts))
        before = factors
        found, followed = variance_components(
            *(tracks, camera_of, priors, state, before, reduced), image_only=not settled
        )
        del reduced  # the next ones take as much
        factors, priors_change = ahead(before, found, followed, priors)
        image_changed = image_change(before, found)
        if settled and max(image_changed, priors_change) < (_ROUGHLY if rough else _STANDS):
            break
        settled = image_changed < 0.1
    if not rough:
        state, used, _ = _converge(tracks, camera_of, priors, state, factors, _MOST_STEPS, _FINE)
        steps += used
    return state, priors, factors, steps


def _converge(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    state: State,
    factors: Factors,
    most: int,
    stop: _Stop,
) -> tuple[State, tuple[SolveStep, ...], Reduced]:
    """Steps until `stop`, or `most`: the state, the steps, and the last one's equations, not damped."""
    sd_m = pose_sd(priors, factors)[:, :3]
    damping, cost = 0.0, cost_of(tracks, camera_of, priors, state, factors)
    steps: list[SolveStep] = []
    while True:
        normals = normals_of(tracks, camera_of, priors, state, factors)
        gain, moved, step_m = 0.0, 0.0, 0.0
        while True:
            try:
                reduced = reduce_normals(normals, damping)
                step = _of_unknowns(priors, *reduced.solve())
            except NotSolvableError:
                if damping > _MOST_DAMPING:
                    raise
                damping = max(10.0 * damping, _DAMPING)
                continue
            whole = damping == 0.0
            alone = wandering(reduced) if whole else np.zeros(0, np.intp)
            for share in _SHARES if whole else _SHARES[:1]:
                trial = stepped(state, share, *step)
                trial = settled_points(tracks, camera_of, priors, trial, factors, alone)
                trial = _kept_away(tracks, priors, state, trial)
                trial_cost = cost_of(tracks, camera_of, priors, trial, factors)
                if trial_cost < cost:
                    break
            if trial_cost < cost or damping > _MOST_DAMPING or _share_moved(step, sd_m) < stop.move:
                break
            damping = max(10.0 * damping, _DAMPING)
        if trial_cost < cost:
            gain, moved = cost - trial_cost, _share_moved(step, sd_m)
            step_m = float(np.linalg.norm(trial.positions - state.positions, axis=1).max())
            state, cost = trial, trial_cost
        down = _down_weighted(tracks, camera_of, priors, state, factors)
        steps.append(SolveStep("", cost, factors.image_px, damping, step_m, down))
        little = gain <= stop.gain * max(cost, 1.0) or reduced.length(*step) <= stop.step
        if len(steps) >= most or (little and moved <= stop.move):
            return state, tuple(steps), reduced if damping == 0.0 else reduce_normals(normals)
        damping = damping / 100.0 if damping > 100.0 * _DAMPING else 0.0
        del normals, reduced  # the next ones take as much


def _down_weighted(tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors) -> float:
    """The share of the image observations that count for less than half."""
    length = lengths_px(tracks, camera_of, priors, state)
    length = length / (image_sd_px(tracks, priors, factors) * np.sqrt(share_shown(tracks, priors)))
    return share_down_weighted(np.nan_to_num(length[has_say(tracks, priors)], nan=np.inf))


def _of_unknowns(
    priors: Priors, pose: Floats, interior: Floats, points: Floats, level: float, mounting: Floats
) -> Step:
    """A step without what it leaves of known and held numbers: a readout that stays doesn't follow the
    block's scale either (`stepped`)."""
    of_cameras, of_platform = np.split(~known(priors), [interior.size])
    return (
        pose,
        interior * of_cameras.reshape(interior.shape),
        points,
        level,
        mounting * of_platform[: mounting.size],
    )


def _kept_away(tracks: Tracks, priors: Priors, before: State, after: State) -> State:
    """The state after a step, but that points which would come too near to a camera stay where they were."""
    if priors.clearance_m is None:
        return after
    held = too_near(tracks, priors.clearance_m, after.positions, after.points)
    if not len(held):
        return after
    points = after.points.copy()
    points[held] = before.points[held]
    return replace(after, points=points)


def _share_moved(step: Step, sd_m: Floats) -> float:
    """The largest move of a frame, as a share of its position's deviation."""
    return float((np.abs(step[0][:, :3]) / sd_m).max())
