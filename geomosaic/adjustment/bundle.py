"""Bundle adjustment: poses, lenses and ground points at once, with POS as weighted observations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.bundle_equations import (
    KNOWN,
    cost_of,
    image_sd_px,
    lengths_px,
    normals_of,
    observed,
    shared_miss,
    strayed_principal_points,
)
from geomosaic.adjustment.bundle_model import GROUPS, MEASURED_SD_PX, Bundle, Priors, State, with_interior
from geomosaic.adjustment.collinearity import exp_turn, image_from_ground, interior_of
from geomosaic.adjustment.mounting import MOUNTING
from geomosaic.adjustment.normal import reduce_normals
from geomosaic.adjustment.robust import cauchy_weight
from geomosaic.adjustment.tracks import Tracks
from geomosaic.adjustment.variance import median_px, trust_in_tags, undetermined, variance_components
from geomosaic.camera.exterior import Poses

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
_ROUGH, _FINE = 1e-3, 1e-5
_STEPS_BETWEEN = 2
_DAMPING = 1e-9


def solve_bundle(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    start: Poses,
    *,
    again: Bundle | None = None,
    sigma_px: float = 0.5,
    most: int = 30,
) -> Bundle:
    """Levenberg-Marquardt on the reduced normal equations, Cauchy weights, variance components.

    Minimises sum rho(|residual| / sigma_px) + the priors' squares (positions, attitudes, interior
    orientation, points). After every convergence the groups' variance factors (image, horizontal and
    vertical position, tilt, yaw) are estimated anew from residuals and redundancy (Förstner 1979), so a
    wrongly stated deviation does no harm; two or three rounds settle them. Hand-measured image
    coordinates have their stated deviation; as long as most of them miss by more, since the block is not
    yet where control wants it, they count by their median miss, so that control pulls as one and a
    blunder stays outvoted.

    Args: start: poses to begin from (the priors' own may be far off); again: an earlier solution whose
        lenses, points and variance components to go on from.
    Raises: NotSolvableError if the system is singular.
    """
    state = State(
        start.positions_m.copy(),
        start.rotations.copy(),
        np.stack([interior_of(c) for c in (again.cameras if again else priors.cameras)]),
        again.points_m if again else priors.points_m,
        again.mounting if again else np.zeros(len(MOUNTING)),
    )
    length = lengths_px(tracks, camera_of, priors, state)
    control = priors.control[tracks.point]
    sigma = dict.fromkeys(GROUPS, 1.0) | {
        "image": max(sigma_px, median_px(length[~control])),
        "control": max(MEASURED_SD_PX, median_px(length[control])),
    }
    sigma |= again.sigma if again else {}
    held = strayed = np.zeros(shared_miss(priors, state).size, dtype=bool)
    iterations = 0
    while True:
        priors = replace(priors, held=held)
        state, priors, used = _settle(tracks, camera_of, priors, state, sigma, most)
        iterations += used
        strayed = strayed | strayed_principal_points(priors, state)
        more = held | strayed | undetermined(tracks, camera_of, priors, state, sigma)
        if np.array_equal(more, held):
            return replace(_finish(tracks, camera_of, priors, state, sigma, iterations), strayed=strayed)
        held = more
        given = np.stack([interior_of(c) for c in priors.cameras])
        state = replace(
            state,
            interior=np.where(held[: given.size].reshape(given.shape), given, state.interior),
            mounting=np.where(held[given.size :], 0.0, state.mounting),
        )


def _settle(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, sigma: dict[str, float], most: int
) -> tuple[State, Priors, int]:
    """Iterates until unknowns, trust and variance components (in place) stand; the steps it took."""
    iterations, settled = 0, False
    for _ in range(12):
        priors = replace(priors, trust=trust_in_tags(priors, state, sigma))
        state, used = _converge(
            tracks, camera_of, priors, state, sigma, _STEPS_BETWEEN if iterations else most, _ROUGH
        )
        iterations += used
        image_changed, priors_changed = variance_components(
            tracks, camera_of, priors, state, sigma, image_only=not settled
        )
        if settled and max(image_changed, priors_changed) < 0.03:
            break
        settled = image_changed < 0.1
    state, used = _converge(tracks, camera_of, priors, state, sigma, most, _FINE)
    return state, priors, iterations + used


def _converge(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    state: State,
    sigma: dict[str, float],
    most: int,
    gain_left: float,
) -> tuple[State, int]:
    damping, cost = _DAMPING, cost_of(tracks, camera_of, priors, state, sigma)
    for iteration in range(1, most + 1):
        normals = normals_of(tracks, camera_of, priors, state, sigma)
        while True:
            pose, interior, point, level, mounting = reduce_normals(normals, damping).solve()
            trial = State(
                state.positions + pose[:, :3],
                exp_turn(pose[:, 3:]) @ state.rotations,
                state.interior + interior,
                state.points + point,
                state.mounting + mounting if mounting.size else state.mounting,
                state.level + level,
            )
            trial_cost = cost_of(tracks, camera_of, priors, trial, sigma)
            if trial_cost <= cost or damping > 1e6:
                break
            damping *= 10.0
        gain = cost - trial_cost
        if gain > 0.0:
            state, cost = trial, trial_cost
        damping = max(damping / 100.0, _DAMPING)
        if gain <= gain_left * max(cost, 1.0):
            return state, iteration
    return state, most


def _held_variance(priors: Priors, held: Bools, unknowns: int) -> Floats:
    """Prior variances of the held numbers in the order of `Reduced`, (s,): the ground's level stands between
    the cameras' and the mounting's."""
    sd = np.concatenate([priors.interior_sd.ravel(), priors.mounting.sd])
    return np.insert(np.where(held, sd, 0.0) ** 2, priors.interior_sd.size, 0.0)[:unknowns]


def _finish(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, sigma: dict[str, float], iterations: int
) -> Bundle:
    reduced = reduce_normals(normals_of(tracks, camera_of, priors, state, sigma))
    if priors.held is not None and priors.held.any():
        reduced = reduced.considering(_held_variance(priors, priors.held, len(reduced.shared)))
    covariance, shared = reduced.covariance()
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    image = image_from_ground(*observed(tracks, camera_of, priors, state))
    residual = tracks.image_px - image
    cameras, mounting = state.interior.size, state.mounting.size
    solved = np.r_[0:cameras, cameras + 1 : len(shared)]
    full = np.eye(cameras + mounting) * KNOWN**2
    full[: len(solved), : len(solved)] = shared[np.ix_(solved, solved)]
    spread = np.sqrt(np.diag(full))
    return Bundle(
        poses=replace(
            priors.poses,
            positions_m=state.positions,
            rotations=state.rotations,
            positions_sd_m=sd[:, :3],
            rotations_sd_rad=sd[:, 3:],
        ),
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
        weight=np.nan_to_num(
            cauchy_weight(np.linalg.norm(residual, axis=1) / image_sd_px(tracks, priors, sigma))
        ),
        sigma_px=sigma["image"],
        sigma={g: sigma[g] for g in GROUPS},
        iterations=iterations,
        reduced=reduced,
    )
