"""Bundle adjustment: poses, lenses and ground points at once, with POS as weighted observations."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import SolveStep
from geomosaic.adjustment.problem.bundle_model import (
    READOUT,
    Begun,
    Bundle,
    Factors,
    Priors,
    State,
    with_interior,
)
from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.solver.bundle_equations import (
    KNOWN,
    has_say,
    image_sd_px,
    lengths_px,
    longest_side_px,
    normals_of,
    pose_sd,
    seen_px,
    share_shown,
    shared_miss,
    shared_sd,
    strayed_principal_points,
    trust_of,
)
from geomosaic.adjustment.solver.bundle_steps import settle, with_held
from geomosaic.adjustment.solver.clearance import clearances_m
from geomosaic.adjustment.solver.normal_equations import Reduced, reduce_normals
from geomosaic.adjustment.solver.prior_reweighting import median_px
from geomosaic.adjustment.solver.variance_components import undetermined
from geomosaic.adjustment.terms.collinearity import INTERIOR, interior_of
from geomosaic.adjustment.terms.mounting import MOUNTING
from geomosaic.adjustment.terms.rolling_shutter_rotation import with_drift, with_swing
from geomosaic.camera.exterior import Poses
from geomosaic.constants import tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.robust import student_weight

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
_MOST_LEFT_OUT = tuned(
    0.5,
    "share of the frames",
    "that may be left out since the system breaks down at them: what is left is half a survey",
)
_ANYWHERE_M = tuned(
    1e3,
    "m",
    "deviation of a frame that is left out and whose position is not given: with more, the equations "
    "lose their digits",
)


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
        **_first_while_read(priors, again),
    )
    settled = again is not None and same_model and len(again.factors.while_read) == _components(priors)
    factors = again.factors if again and settled else _first_factors(tracks, camera_of, priors, state)
    clearance_m = clearances_m(tracks, state.positions, state.points)
    priors = replace(priors, unrest=again.unrest if again else None, clearance_m=clearance_m)
    held = again.held if again else np.full(shared_miss(priors, state).size, lens_held)
    strayed = np.zeros_like(held)
    steps: tuple[SolveStep, ...] = ()
    may_free, shown = again is not None, np.zeros(len(priors.cameras))
    while True:
        priors = replace(priors, held=held)
        state = with_held(tracks, camera_of, priors, state, factors)
        state, priors, factors, used = settle(
            tracks, camera_of, priors, state, factors, rough=True, settled=settled
        )
        steps += used
        strayed = strayed | strayed_principal_points(priors, state)
        more = strayed | undetermined(tracks, camera_of, priors, state, factors)
        more = more if may_free and not lens_held else held | more
        if np.array_equal(more, held):
            break
        held, may_free = more, False
    if not rough:
        state, priors, factors, used = settle(
            tracks, camera_of, priors, state, factors, rough=False, settled=True
        )
        steps += used
        priors, shown = _with_unreported_shutters(tracks, camera_of, priors, state, factors)
    found = _finish(tracks, camera_of, priors, state, factors, len(steps))
    before = again.steps if isinstance(again, Bundle) else ()
    return replace(found, strayed=strayed, held=held, readout_shown=shown, steps=before + steps)


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


def _first_while_read(priors: Priors, again: Begun | None) -> dict[str, Floats | None]:
    """Swing and drift as found before, if by the same functions of the row."""
    if priors.swing_sd_rad is None:
        return {}
    before = None if again is None else again.swing
    if again is None or before is None or before.shape != priors.swing_sd_rad.shape:
        return {"swing": np.zeros(priors.swing_sd_rad.shape), "drift_m": np.zeros((len(priors.poses), 3))}
    return {"swing": before, "drift_m": again.drift_m}


def _components(priors: Priors) -> int:
    """Of what frames do while their rows are read: the swing's functions, drifts along the ground and up."""
    return 0 if priors.swing_sd_rad is None else priors.swing_sd_rad.shape[1] + 2


def _first_factors(tracks: Tracks, camera_of: Ints, priors: Priors, state: State) -> Factors:
    """Image coordinates count by their present median miss, all else as stated."""
    length = lengths_px(tracks, camera_of, priors, state)
    control, most_px = priors.control[tracks.point], longest_side_px(priors)
    return Factors(
        while_read=(1.0,) * _components(priors),
        image_px=float(np.clip(median_px(length[~control]), Factors.image_px, most_px)),
        control_px=float(np.clip(median_px(length[control]), Factors.control_px, most_px)),
    )


def _held_variance(priors: Priors, held: Bools, unknowns: int) -> Floats:
    """Prior variances of the held numbers in the order of `Reduced`, (s,): the ground's level stands between
    the cameras' and the mounting's."""
    sd = np.concatenate([priors.interior_sd.ravel(), priors.mounting.sd])
    return np.insert(np.where(held, sd, 0.0) ** 2, priors.interior_sd.size, 0.0)[:unknowns]


def _points_sd_m(reduced: Reduced, priors: Priors) -> Floats:
    """Deviations (p, 3) for poses and cameras without error; those before of points that took no part."""
    return _deviations(np.diagonal(reduced.points_inverse, axis1=1, axis2=2), priors.points_sd_m)


def _deviations(variance: Floats, before: Floats) -> Floats:
    """Their roots; the deviations before the solve where rounding left none above zero."""
    return np.asarray(np.where(variance > 0.0, np.sqrt(np.maximum(variance, 0.0)), before))


def _finish(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors, iterations: int
) -> Bundle:
    reduced = reduce_normals(normals_of(tracks, camera_of, priors, state, factors))
    if priors.held is not None and priors.held.any():
        reduced = reduced.considering(_held_variance(priors, priors.held, len(reduced.shared)))
    covariance, shared = reduced.covariance()
    covariance = covariance[:, :6, :6]
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    sd = _deviations(variance, pose_sd(priors, factors))
    residual = tracks.image_px - seen_px(tracks, camera_of, priors, state)
    standardised = np.linalg.norm(residual, axis=1) / image_sd_px(tracks, priors, factors)
    standardised /= np.sqrt(share_shown(tracks, priors))
    cameras, mounting = state.interior.size, state.mounting.size
    solved = np.r_[0:cameras, cameras + 1 : len(shared)]
    full = np.eye(cameras + mounting) * KNOWN**2
    full[: len(solved), : len(solved)] = shared[np.ix_(solved, solved)]
    spread = _deviations(np.diag(full), shared_sd(priors))
    poses = replace(
        priors.poses,
        positions_m=state.positions,
        rotations=state.rotations,
        positions_sd_m=sd[:, :3],
        rotations_sd_rad=sd[:, 3:],
    )
    if state.swing is not None and state.drift_m is not None:
        poses = with_swing(poses, state.swing, state.interior[camera_of, READOUT])
        poses = with_drift(poses, state.drift_m, state.interior[camera_of, READOUT])
    return Bundle(
        poses=poses,
        cameras=tuple(with_interior(c, row) for c, row in zip(priors.cameras, state.interior, strict=True)),
        points_m=state.points,
        points_sd_m=_points_sd_m(reduced, priors),
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
        drift_m=state.drift_m,
        level_m=state.level,
        iterations=iterations,
        reduced=reduced,
        readout_shown=np.zeros(len(state.interior)),
    )
