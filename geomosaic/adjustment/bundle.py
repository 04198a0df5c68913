"""Bundle adjustment: poses, lenses and ground points at once, with POS as weighted observations."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.bundle_equations import (
    KNOWN,
    cost_of,
    has_say,
    image_sd_px,
    known,
    lengths_px,
    normals_of,
    pose_sd,
    seen_px,
    share_shown,
    shared_miss,
    strayed_principal_points,
    trust_of,
)
from geomosaic.adjustment.bundle_model import (
    READOUT,
    Begun,
    Bundle,
    Factors,
    Priors,
    State,
    stepped,
    with_interior,
)
from geomosaic.adjustment.clearance import clearances_m, too_near
from geomosaic.adjustment.collinearity import INTERIOR, interior_of
from geomosaic.adjustment.mounting import MOUNTING
from geomosaic.adjustment.normal import Reduced, reduce_normals
from geomosaic.adjustment.robust import student_weight
from geomosaic.adjustment.swing import with_swing
from geomosaic.adjustment.tracks import Tracks
from geomosaic.adjustment.unrest import unrest
from geomosaic.adjustment.variance import (
    ahead,
    change_of,
    median_px,
    trust_in_tags,
    undetermined,
    variance_components,
)
from geomosaic.camera.exterior import Poses
from geomosaic.constants import CHOSEN, Because
from geomosaic.errors import NotSolvableError

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class _Stop:
    """A step is the last if it moves no frame by more than `move` of its position's deviation, and gains no
    more than `gain` of the cost or is no longer than `step` (`Reduced.length`). By its gain alone a large
    block would stop while its scale is still off, as among 100,000 observations such a gain hides, and others
    would wait for single blunders to wander off while all frames stand still."""

    gain: float
    move: float
    step: float


_ROUGH: Annotated[
    _Stop,
    Because(
        "share of the cost, share of a position's deviation, deviations of what is solved",
        "a block that is to be judged, or whose variance components come next: what is left moves no "
        "judgement. With a gain of a hundredth, components were found before lenses had settled, and a block "
        "with rolling shutters ended 0.2 deviations elsewhere",
        CHOSEN,
    ),
] = _Stop(1e-3, 0.3, 0.0)
_FINE: Annotated[
    _Stop,
    Because(
        "share of the cost, share of a position's deviation, deviations of what is solved",
        "what is left is some hundredths of what anything is good to: points with an image far off make "
        "steps shrink by a tenth at a time, so that steps of 0.02 may leave 0.08",
        "computed of a block of six frames with such points (tests/test_bundle_oracle.py): 0.03 and 0.02 "
        "leave 0.09 and 0.08 of a lens's deviation, 0.015 less than 0.06",
    ),
] = _Stop(1e-7, 0.01, 0.015)
_STANDS: Annotated[
    float,
    Because(
        "share of a variance component",
        "by which it may still change when it stands: of a dozen frames it is known to a third itself",
        CHOSEN,
    ),
] = 0.03
_ROUGHLY: Annotated[
    float,
    Because(
        "share of a variance component",
        "the same, well enough to compare models",
        CHOSEN,
    ),
] = 0.15
_STEPS_BETWEEN: Annotated[
    int,
    Because(
        "steps",
        "between estimates of the variance components: a block that all but stands needs no more",
        CHOSEN,
    ),
] = 2
_MOST_STEPS: Annotated[
    int,
    Because(
        "steps",
        "of a block that begins anywhere: those that settle take 5 to 15",
        CHOSEN,
    ),
] = 30
_DAMPING: Annotated[
    float,
    Because(
        "share of the diagonal",
        "least damping once a step fails: the diagonal holds thousands of sharp image coordinates, so "
        "that even this holds up scale, turn and place of the whole block, which only the positions know",
        CHOSEN,
    ),
] = 1e-9
_MOST_DAMPING: Annotated[
    float,
    Because(
        "share of the diagonal",
        "steps are next to none with more: the system is broken",
        CHOSEN,
    ),
] = 1e6
_SHARES: Annotated[
    tuple[float, ...],
    Because(
        "of a step",
        "that are tried before damping if the whole would raise the cost: a part goes the same way, also "
        "for the block as a whole",
        CHOSEN,
    ),
] = (1.0, 0.5, 0.25, 0.1)
_MOST_LEFT_OUT: Annotated[
    float,
    Because(
        "share of the frames",
        "that may be left out since the system breaks down at them: what is left is half a survey",
        CHOSEN,
    ),
] = 0.5
_ANYWHERE_M: Annotated[
    float,
    Because(
        "m",
        "deviation of a frame that is left out and whose position is not given: with more, the equations "
        "lose their digits",
        CHOSEN,
    ),
] = 1e3
Step = tuple[Floats, Floats, Floats, float, Floats]


def solve_bundle(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    start: Poses,
    *,
    again: Begun | None = None,
    same_model: bool = True,
    rough: bool = False,
    lens_held: bool = False,
) -> Bundle:
    """Scoring on the reduced normal equations, Student's distribution of image errors, variance components.

    Minimises sum rho(|residual| / sigma_px) + the priors' squares (positions, attitudes, interior
    orientation, points). After every convergence the groups' variance factors (image, horizontal and
    vertical position, tilt, yaw) are estimated anew from residuals and redundancy (Förstner 1979), so a
    wrongly stated deviation does no harm; two or three rounds settle them. Hand-measured image
    coordinates have their stated deviation; as long as most of them miss by more, since the block is not
    yet where control wants it, they count by their median miss, so that control pulls as one and a
    blunder stays outvoted.

    Frames at which the system breaks down are left out and tried again once all others are solved.

    Args: start: poses to begin from (the priors' own may be far off); again: an earlier solution whose
        lenses, points and variance components to go on from; same_model: whether they are those of this
        model of lens and shutter, or only where to begin. rough: to compare models by, in half the time.
        lens_held: what frames share stays as it is given.
    Raises: NotSolvableError if more than half of the frames would have to be left out.
    """
    left_out = np.zeros(len(start), dtype=bool)
    while True:
        try:
            solved = _solve(
                *(tracks, camera_of, _without(priors, left_out, start), start),
                *(again, same_model, rough, lens_held),
            )
            break
        except NotSolvableError as error:
            weak = [i for i in error.frames if not left_out[i]]
            if not weak or left_out.sum() + len(weak) > _MOST_LEFT_OUT * len(start):
                raise
            left_out[weak] = True
    if left_out.any():
        with suppress(NotSolvableError):
            return _solve(tracks, camera_of, priors, solved.poses, solved, True, rough, lens_held)
    return solved


def _without(priors: Priors, left_out: Bools, start: Poses) -> Priors:
    """Frames whose images don't count stay where they began."""
    if not left_out.any():
        return priors
    poses, out = priors.poses, left_out[:, None]
    stay = replace(
        poses,
        positions_m=np.where(out, start.positions_m, poses.positions_m),
        rotations=np.where(out[:, None], start.rotations, poses.rotations),
        positions_sd_m=np.where(out, np.minimum(poses.positions_sd_m, _ANYWHERE_M), poses.positions_sd_m),
        rotations_sd_rad=np.where(out, np.minimum(poses.rotations_sd_rad, np.pi), poses.rotations_sd_rad),
    )
    return replace(priors, poses=stay, left_out=left_out)


def _solve(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    start: Poses,
    again: Begun | None,
    same_model: bool,
    rough: bool,
    lens_held: bool,
) -> Bundle:
    """The solution with all unknowns that the block determines."""
    state = State(
        start.positions_m.copy(),
        start.rotations.copy(),
        np.stack([interior_of(c) for c in (again.cameras if again else priors.cameras)]),
        again.points_m if again else priors.points_m,
        again.mounting if again else np.zeros(len(MOUNTING)),
        level=again.level_m if again else 0.0,
        swing=_first_swing(priors, again),
    )
    terms = 0 if priors.swing_sd_rad is None else priors.swing_sd_rad.shape[1]
    settled = again is not None and same_model and len(again.factors.swing) == terms
    factors = again.factors if again and settled else _first_factors(tracks, camera_of, priors, state)
    clearance_m = clearances_m(tracks, state.positions, state.points)
    priors = replace(priors, unrest=again.unrest if again else None, clearance_m=clearance_m)
    held = again.held if again else np.full(shared_miss(priors, state).size, lens_held)
    strayed = np.zeros_like(held)
    iterations, may_free, shown = 0, again is not None, np.zeros(len(priors.cameras))
    while True:
        priors = replace(priors, held=held)
        state = _with_held(tracks, camera_of, priors, state, factors)
        state, priors, factors, used = _settle(
            tracks, camera_of, priors, state, factors, rough=True, settled=settled
        )
        iterations += used
        strayed = strayed | strayed_principal_points(priors, state)
        more = strayed | undetermined(tracks, camera_of, priors, state, factors)
        more = more if may_free and not lens_held else held | more
        if np.array_equal(more, held):
            break
        held, may_free = more, False
    if not rough:
        state, priors, factors, used = _settle(
            tracks, camera_of, priors, state, factors, rough=False, settled=True
        )
        iterations += used
        priors, shown = _with_unreported_shutters(tracks, camera_of, priors, state, factors)
    found = _finish(tracks, camera_of, priors, state, factors, iterations)
    return replace(found, strayed=strayed, held=held, readout_shown=shown)


def _with_unreported_shutters(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors
) -> tuple[Priors, Floats]:
    """A readout that is not reported and isn't solved for is held at none: what it may be off counts,
    the step that the images would have it make and that step's deviation.

    The second, (c,), is the step by its deviation, a score test (Rao 1948): many frames together may show
    what in each image is far below the noise.
    """
    sd, held, shown = priors.interior_sd.copy(), priors.held, np.zeros(len(priors.cameras))
    unreported = np.array([0.0 if c.readout_s else c.readout_sd_s for c in priors.cameras])
    unreported[sd[:, READOUT] > 0.0] = 0.0
    if priors.poses.velocities_m_per_s is None or held is None or not unreported.any():
        return priors, shown
    sd[:, READOUT] += unreported
    free = reduce_normals(normals_of(tracks, camera_of, replace(priors, interior_sd=sd), state, factors))
    readouts = np.arange(len(unreported)) * len(INTERIOR) + READOUT
    step_s = free.solve()[1].ravel()[readouts]
    own_s = np.sqrt(np.diag(free.covariance()[1])[readouts])
    sd[:, READOUT] = np.where(unreported > 0.0, np.hypot(step_s, own_s), sd[:, READOUT])
    off = np.zeros(len(held), dtype=bool)
    off[readouts] = unreported > 0.0
    return replace(priors, interior_sd=sd, held=held | off), np.where(unreported > 0.0, step_s / own_s, 0.0)


def _first_swing(priors: Priors, again: Begun | None) -> Floats | None:
    """As found before, if by the same functions of the row."""
    if priors.swing_sd_rad is None:
        return None
    none = np.zeros((len(priors.poses), priors.swing_sd_rad.shape[1], 3))
    before = None if again is None else again.swing
    return none if before is None or before.shape != none.shape else before


def _with_held(tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors) -> State:
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


def _first_factors(tracks: Tracks, camera_of: Ints, priors: Priors, state: State) -> Factors:
    """Image coordinates count by their present median miss, all else as stated."""
    length = lengths_px(tracks, camera_of, priors, state)
    control = priors.control[tracks.point]
    terms = 0 if priors.swing_sd_rad is None else priors.swing_sd_rad.shape[1]
    return Factors(
        swing=(1.0,) * terms,
        image_px=max(Factors.image_px, median_px(length[~control])),
        control_px=max(Factors.control_px, median_px(length[control])),
    )


def _settle(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    state: State,
    factors: Factors,
    *,
    rough: bool,
    settled: bool,
) -> tuple[State, Priors, Factors, int]:
    """Iterates until unknowns, trust and variance components stand; the steps it took. settled: whether the
    image's component is believed to stand already."""
    iterations, change = 0, None
    for _ in range(12):
        priors = replace(priors, trust=trust_in_tags(priors, state, factors))
        state, used, reduced = _converge(
            *(tracks, camera_of, priors, state, factors),
            *(_STEPS_BETWEEN if iterations else _MOST_STEPS, _ROUGH),
        )
        iterations += used
        if settled:
            counts = ~priors.control[tracks.point] & has_say(tracks, priors)
            length_px = lengths_px(tracks, camera_of, priors, state)
            priors = replace(priors, unrest=unrest(tracks, state.points, length_px, counts))
        before = factors
        factors = variance_components(
            *(tracks, camera_of, priors, state, before, reduced), image_only=not settled
        )
        image_changed, priors_changed = change_of(before, factors)
        if settled and max(image_changed, priors_changed) < (_ROUGHLY if rough else _STANDS):
            break
        factors, change = ahead(before, factors, change, priors)
        settled = image_changed < 0.1
    if not rough:
        state, used, _ = _converge(tracks, camera_of, priors, state, factors, _MOST_STEPS, _FINE)
        iterations += used
    return state, priors, factors, iterations


def _converge(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    state: State,
    factors: Factors,
    most: int,
    stop: _Stop,
) -> tuple[State, int, Reduced]:
    """Steps until `stop`, or `most`: the state, how many, and the last one's equations, not damped."""
    sd_m = pose_sd(priors, factors)[:, :3]
    damping, cost = 0.0, cost_of(tracks, camera_of, priors, state, factors)
    steps, stands = 0, False
    while steps < most and not stands:
        steps += 1
        normals = normals_of(tracks, camera_of, priors, state, factors)
        gain, moved = 0.0, 0.0
        while True:
            try:
                reduced = reduce_normals(normals, damping)
                step = _of_unknowns(priors, *reduced.solve())
            except NotSolvableError:
                if damping > _MOST_DAMPING:
                    raise
                damping = max(10.0 * damping, _DAMPING)
                continue
            for share in _SHARES:
                trial = _kept_away(tracks, priors, state, stepped(state, share, *step))
                trial_cost = cost_of(tracks, camera_of, priors, trial, factors)
                if trial_cost < cost:
                    break
            if trial_cost < cost or damping > _MOST_DAMPING or _share_moved(step, sd_m) < stop.move:
                break
            damping = max(10.0 * damping, _DAMPING)
        if trial_cost < cost:
            gain, moved = cost - trial_cost, _share_moved(step, sd_m)
            state, cost = trial, trial_cost
        whole = reduced if damping == 0.0 else None
        damping = damping / 100.0 if damping > 100.0 * _DAMPING else 0.0
        little = gain <= stop.gain * max(cost, 1.0) or reduced.length(*step) <= stop.step
        stands = little and moved <= stop.move
    return state, steps, whole or reduce_normals(normals)


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


def _held_variance(priors: Priors, held: Bools, unknowns: int) -> Floats:
    """Prior variances of the held numbers in the order of `Reduced`, (s,): the ground's level stands between
    the cameras' and the mounting's."""
    sd = np.concatenate([priors.interior_sd.ravel(), priors.mounting.sd])
    return np.insert(np.where(held, sd, 0.0) ** 2, priors.interior_sd.size, 0.0)[:unknowns]


def _finish(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors, iterations: int
) -> Bundle:
    reduced = reduce_normals(normals_of(tracks, camera_of, priors, state, factors))
    if priors.held is not None and priors.held.any():
        reduced = reduced.considering(_held_variance(priors, priors.held, len(reduced.shared)))
    covariance, shared = reduced.covariance()
    covariance = covariance[:, :6, :6]
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    residual = tracks.image_px - seen_px(tracks, camera_of, priors, state)
    standardised = np.linalg.norm(residual, axis=1) / image_sd_px(tracks, priors, factors)
    standardised /= np.sqrt(share_shown(tracks, priors))
    cameras, mounting = state.interior.size, state.mounting.size
    solved = np.r_[0:cameras, cameras + 1 : len(shared)]
    full = np.eye(cameras + mounting) * KNOWN**2
    full[: len(solved), : len(solved)] = shared[np.ix_(solved, solved)]
    spread = np.sqrt(np.diag(full))
    poses = replace(
        priors.poses,
        positions_m=state.positions,
        rotations=state.rotations,
        positions_sd_m=sd[:, :3],
        rotations_sd_rad=sd[:, 3:],
    )
    if state.swing is not None:
        poses = with_swing(poses, state.swing, state.interior[camera_of, READOUT])
    return Bundle(
        poses=poses,
        cameras=tuple(with_interior(c, row) for c, row in zip(priors.cameras, state.interior, strict=True)),
        points_m=state.points,
        points_sd_m=np.sqrt(np.diagonal(reduced.points_inverse, axis1=1, axis2=2)),
        pose_covariance=covariance,
        interior_sd=spread[:cameras].reshape(state.interior.shape),
        mounting=state.mounting,
        mounting_sd=spread[cameras:],
        shared_correlation=full / spread[:, None] / spread,
        held=np.zeros(len(full), dtype=bool) if priors.held is None else priors.held,
        strayed=np.zeros(len(full), dtype=bool),
        residual_px=residual,
        weight=np.nan_to_num(student_weight(standardised) / student_weight(np.zeros(1)))
        * has_say(tracks, priors),
        unrest=priors.unrest,
        factors=factors,
        trust=trust_of(priors),
        left_out=np.zeros(len(state.positions), dtype=bool) if priors.left_out is None else priors.left_out,
        swing=state.swing,
        level_m=state.level,
        iterations=iterations,
        reduced=reduced,
        readout_shown=np.zeros(len(state.interior)),
    )
