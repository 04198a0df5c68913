"""Bundle adjustment: poses, lenses and ground points at once, with POS as weighted observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.collinearity import INTERIOR, exp_turn, interior_of, log_turn, project
from geomosaic.adjustment.normal import Normals, Reduced, build_normals, reduce_normals
from geomosaic.adjustment.robust import cauchy_cost, cauchy_weight
from geomosaic.adjustment.terrain import Terrain, add_terrain, surface_share, terrain_cost
from geomosaic.adjustment.tracks import Tracks
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
MEASURED_SD_PX = 0.5
"""Of a control or check point measured by hand in a picture: about half a pixel."""
_LEAST_SIGMA_PX = 0.02
_ROUGH, _FINE = 1e-3, 1e-5
_PRIOR_FACTORS = (0.1, 10.0)
_STEPS_BETWEEN = 2
_DAMPING = 1e-9
_GROUPS = ("horizontal", "vertical", "tilt", "yaw")
_MEDIAN_LENGTH = float(np.sqrt(np.log(4.0)))  # of residuals (2,) with a deviation of 1 each


@dataclass(frozen=True)
class Priors:
    """What is believed before the pictures speak, with standard deviations.

    interior_sd (c, 8) in the order of INTERIOR. points_m, points_sd_m (p, 3): for control points
    their own; for tie points the ground below, weakly. control (p,): which points are control, measured
    by hand and not bound to the terrain. terrain: a surface that tie points lie on, if one is known.
    trust (f, 6): factors of the pose priors' weights, 1 but for tags that lie; set by the solver.
    """

    poses: Poses
    cameras: tuple[Camera, ...]
    interior_sd: Floats
    points_m: Floats
    points_sd_m: Floats
    control: Bools
    terrain: Terrain | None = None
    trust: Floats | None = None


@dataclass(frozen=True)
class Bundle:
    """The solution. Covariances are scaled with the estimated variance components.

    points_sd_m: (p, 3), as if poses and cameras were known.
    pose_covariance: (f, 6, 6) of east, north, up (m) and turns about them (rad). interior_sd: (c, 8).
    interior_correlation: (8c, 8c). residual_px: (m, 2) observed minus computed. weight: (m,) robust
    weights, 1 for a good observation. sigma_px: estimated deviation of a tie point's image coordinate.
    sigma: estimated deviation over stated deviation per group. reduced: the last normal equations.
    """

    poses: Poses
    cameras: tuple[Camera, ...]
    points_m: Floats
    points_sd_m: Floats
    pose_covariance: Floats
    interior_sd: Floats
    interior_correlation: Floats
    residual_px: Floats
    weight: Floats
    sigma_px: float
    sigma: dict[str, float]
    iterations: int
    reduced: Reduced


@dataclass
class _State:
    positions: Floats
    rotations: Floats
    interior: Floats
    points: Floats
    level: float = 0.0


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
        lenses and points to go on from.
    Raises: NotSolvableError if the system is singular.
    """
    state = _State(
        start.positions_m.copy(),
        start.rotations.copy(),
        np.stack([interior_of(c) for c in (again.cameras if again else priors.cameras)]),
        again.points_m if again else priors.points_m,
    )
    length = _lengths_px(tracks, camera_of, state)
    control = priors.control[tracks.point]
    sigma = dict.fromkeys(_GROUPS, 1.0) | {
        "image": max(sigma_px, _median(length[~control])),
        "control": max(MEASURED_SD_PX, _median(length[control])),
    }
    iterations, settled = 0, False
    for _ in range(12):
        priors = replace(priors, trust=_trust(priors, state, sigma))
        state, used = _converge(
            tracks, camera_of, priors, state, sigma, _STEPS_BETWEEN if iterations else most, _ROUGH
        )
        iterations += used
        image_changed, priors_changed = _variance_components(
            tracks, camera_of, priors, state, sigma, image_only=not settled
        )
        if settled and max(image_changed, priors_changed) < 0.03:
            break
        settled = image_changed < 0.1
    state, used = _converge(tracks, camera_of, priors, state, sigma, most, _FINE)
    iterations += used
    return _finish(tracks, camera_of, priors, state, sigma, iterations)


def _pose_sd(priors: Priors, sigma: dict[str, float]) -> Floats:
    """Deviations of the pose priors with their present factors, (f, 6); inf where nothing is known."""
    position, turn = priors.poses.positions_sd_m, priors.poses.rotations_sd_rad
    factor = np.array([sigma[g] for g in ("horizontal", "horizontal", "vertical", "tilt", "tilt", "yaw")])
    sd = np.column_stack([position, turn]) * factor
    return np.asarray(np.where(np.isfinite(sd), sd, np.inf))


def _pose_miss(priors: Priors, state: _State) -> Floats:
    """Prior minus present pose, (f, 6)."""
    turn = log_turn(priors.poses.rotations @ np.swapaxes(state.rotations, 1, 2))
    return np.column_stack([priors.poses.positions_m - state.positions, turn])


def _cost(tracks: Tracks, camera_of: Ints, priors: Priors, state: _State, sigma: dict[str, float]) -> float:
    length = _lengths_px(tracks, camera_of, state) / _image_sd_px(tracks, priors, sigma)
    total = cauchy_cost(np.where(np.isfinite(length), length, 1e6))
    total += float((_trust_of(priors) * (_pose_miss(priors, state) / _pose_sd(priors, sigma)) ** 2).sum())
    total += float(
        (
            ((np.stack([interior_of(c) for c in priors.cameras]) - state.interior) / priors.interior_sd) ** 2
        ).sum()
    )
    total += float((((priors.points_m - state.points) / priors.points_sd_m) ** 2).sum())
    if priors.terrain is not None:
        total += terrain_cost(
            priors.terrain,
            ~priors.control,
            state.points,
            state.positions,
            _frame_share(tracks, state),
            state.level,
        )
    return total


def _trust(priors: Priors, state: _State, sigma: dict[str, float]) -> Floats:
    """Cauchy weights of each frame's position and attitude, (f, 6): a wild tag loses its say.

    A frame is wild against the bulk of the others, never all at once: else a whole block that shrinks
    or tips over would free itself from its positions.
    """
    miss = _pose_miss(priors, state) / _pose_sd(priors, sigma)
    length = np.sqrt(np.add.reduceat(miss**2, [0, 3], axis=1))
    bulk = np.maximum(1.0, np.median(length, axis=0) / 1.5)
    return np.repeat(cauchy_weight(length / bulk), 3, axis=1)


def _trust_of(priors: Priors) -> Floats:
    return np.ones((len(priors.poses), 6)) if priors.trust is None else priors.trust


def _projected(tracks: Tracks, camera_of: Ints, state: _State) -> tuple[Floats, Floats, Floats, Floats]:
    return project(
        state.positions[tracks.frame],
        state.rotations[tracks.frame],
        state.interior[camera_of[tracks.frame]],
        state.points[tracks.point],
    )


def _lengths_px(tracks: Tracks, camera_of: Ints, state: _State) -> Floats:
    """Lengths of the image residuals, (m,); NaN behind the camera."""
    return np.asarray(np.linalg.norm(tracks.image_px - _projected(tracks, camera_of, state)[0], axis=1))


def _image_sd_px(tracks: Tracks, priors: Priors, sigma: dict[str, float]) -> Floats:
    """Present deviation of each observation, (m,): hand-measured control apart from tie points."""
    return np.where(priors.control[tracks.point], sigma["control"], sigma["image"])


def _median(lengths_px: Floats) -> float:
    """Median of what is known, else 0."""
    known = lengths_px[np.isfinite(lengths_px)]
    return float(np.median(known)) if known.size else 0.0


def _frame_share(tracks: Tracks, state: _State) -> Floats:
    """Each frame's share of the observations, (f,)."""
    return np.bincount(tracks.frame, minlength=len(state.positions)) / max(len(tracks.frame), 1)


def _normals(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: _State, sigma: dict[str, float]
) -> Normals:
    image, by_pose, by_interior, by_point = _projected(tracks, camera_of, state)
    residual = tracks.image_px - image
    seen = np.asarray(np.isfinite(residual).all(axis=1))
    residual = np.where(seen[:, None], residual, 0.0)
    sd_px = _image_sd_px(tracks, priors, sigma)
    weight = cauchy_weight(np.linalg.norm(residual, axis=1) / sd_px) / sd_px**2
    weight = np.where(seen, weight, 0.0)
    clean = [np.where(seen[:, None, None], a, 0.0) for a in (by_pose, by_interior, by_point)]
    counts = (len(state.positions), len(state.interior), len(state.points))
    n = build_normals(tracks.frame, tracks.point, camera_of, counts, residual, weight, *clean)
    miss, sd = _pose_miss(priors, state), _pose_sd(priors, sigma)
    pose_weight = _trust_of(priors) / sd**2
    interior_miss = np.stack([interior_of(c) for c in priors.cameras]) - state.interior
    for block, side, w, m in (
        (n.pose, n.pose_side, pose_weight, miss),
        (n.interior, n.interior_side, 1.0 / priors.interior_sd**2, interior_miss),
        (n.points, n.point_side, 1.0 / priors.points_sd_m**2, priors.points_m - state.points),
    ):
        i = np.arange(block.shape[-1])
        block[:, i, i] += w
        side += w * m
    if priors.terrain is None:
        return replace(n, level=1.0)
    share = _frame_share(tracks, state)
    return add_terrain(n, priors.terrain, ~priors.control, state.points, state.positions, share, state.level)


def _converge(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    state: _State,
    sigma: dict[str, float],
    most: int,
    gain_left: float,
) -> tuple[_State, int]:
    damping, cost = _DAMPING, _cost(tracks, camera_of, priors, state, sigma)
    for iteration in range(1, most + 1):
        normals = _normals(tracks, camera_of, priors, state, sigma)
        while True:
            pose, interior, point, level, _ = reduce_normals(normals, damping).solve()
            trial = _State(
                state.positions + pose[:, :3],
                exp_turn(pose[:, 3:]) @ state.rotations,
                state.interior + interior,
                state.points + point,
                state.level + level,
            )
            trial_cost = _cost(tracks, camera_of, priors, trial, sigma)
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


def _variance_components(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    state: _State,
    sigma: dict[str, float],
    *,
    image_only: bool,
) -> tuple[float, float]:
    """Updates the groups' factors in place; returns the relative change of the image's factor and the
    largest of the priors'. The priors' factors wait until the image's has settled: before, they would
    take up what the poses haven't yet."""
    n = _normals(tracks, camera_of, priors, state, sigma)
    reduced = reduce_normals(n)
    covariance, shared = reduced.covariance()
    miss, sd = _pose_miss(priors, state), _pose_sd(priors, sigma)
    weight = _trust_of(priors)
    share = np.diagonal(covariance, axis1=1, axis2=2) * weight / sd**2
    control = priors.control[tracks.point]
    length_px = _lengths_px(tracks, camera_of, state)
    before = sigma["image"], sigma["control"]
    if not control.all():
        length = np.nan_to_num(length_px[~control] / sigma["image"], nan=1e6)
        robust = cauchy_weight(length)
        settled = float(share.sum()) + surface_share(n, reduced.points_inverse)
        settled += float((np.diag(shared)[: state.interior.size] / priors.interior_sd.ravel() ** 2).sum())
        unknowns = 6 * len(state.positions) + state.interior.size + 3 * int((~priors.control).sum()) - settled
        redundancy = max(2.0 * float(robust.sum()) - unknowns, 1.0)
        sigma["image"] *= float(np.sqrt((robust * length**2).sum() / redundancy))
        sigma["image"] = max(sigma["image"], _LEAST_SIGMA_PX)
    sigma["control"] = max(MEASURED_SD_PX, _median(length_px[control]) / _MEDIAN_LENGTH)
    after = sigma["image"], sigma["control"]
    image_changed = float(np.abs(np.log(np.divide(after, before))).max())
    if image_only:
        return image_changed, 0.0
    changes = [0.0]
    for group, columns in (("horizontal", [0, 1]), ("vertical", [2]), ("tilt", [3, 4]), ("yaw", [5])):
        known = np.asarray(np.isfinite(sd[:, columns]))
        r = float((weight[:, columns] - share[:, columns])[known].sum())
        if r < 3.0:
            continue
        total = float((weight[:, columns] * (miss[:, columns] / sd[:, columns]) ** 2)[known].sum())
        factor = sigma[group]
        sigma[group] = float(np.clip(factor * np.sqrt(total / r), *_PRIOR_FACTORS))
        changes.append(float(abs(np.log(sigma[group] / factor))))
    return image_changed, max(changes)


def _finish(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: _State, sigma: dict[str, float], iterations: int
) -> Bundle:
    n = _normals(tracks, camera_of, priors, state, sigma)
    reduced = reduce_normals(n)
    covariance, shared = reduced.covariance()
    full = shared[: state.interior.size, : state.interior.size]
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    image, *_ = _projected(tracks, camera_of, state)
    residual = tracks.image_px - image
    spread = np.sqrt(np.diag(full))
    return Bundle(
        poses=Poses(state.positions, state.rotations, sd[:, :3], sd[:, 3:]),
        cameras=tuple(with_interior(c, row) for c, row in zip(priors.cameras, state.interior, strict=True)),
        points_m=state.points,
        points_sd_m=np.sqrt(np.diagonal(reduced.points_inverse, axis1=1, axis2=2)),
        pose_covariance=covariance,
        interior_sd=spread.reshape(state.interior.shape),
        interior_correlation=full / spread[:, None] / spread,
        residual_px=residual,
        weight=np.nan_to_num(
            cauchy_weight(np.linalg.norm(residual, axis=1) / _image_sd_px(tracks, priors, sigma))
        ),
        sigma_px=sigma["image"],
        sigma={g: sigma[g] for g in _GROUPS},
        iterations=iterations,
        reduced=reduced,
    )


def with_interior(camera: Camera, interior: Sequence[float] | Floats) -> Camera:
    """The camera with other numbers, in the order of INTERIOR."""
    values: dict[str, Any] = {name: float(v) for name, v in zip(INTERIOR, interior, strict=True)}
    return replace(camera, **values)
