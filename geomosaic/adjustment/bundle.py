"""Bundle adjustment: poses, lenses and ground points at once, with POS as weighted observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.collinearity import (
    INTERIOR,
    exp_turn,
    image_from_ground,
    interior_of,
    passing,
    project,
)
from geomosaic.adjustment.mounting import MOUNTING, Mounting, mounting_derivatives, pose_miss
from geomosaic.adjustment.normal import Normals, Reduced, build_normals, reduce_normals
from geomosaic.adjustment.robust import cauchy_cost, cauchy_weight, lie_weight
from geomosaic.adjustment.terrain import Terrain, add_terrain, surface_share, terrain_cost
from geomosaic.adjustment.tracks import Tracks
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
MEASURED_SD_PX = 0.5
"""Of a control or check point measured by hand in a picture: about half a pixel."""
NO_MOUNTING = Mounting(np.zeros(len(MOUNTING)))
_LEAST_SIGMA_PX = 0.02
_KNOWN = 1e-6
_DETERMINED = 0.9
_ROUGH, _FINE = 1e-3, 1e-5
_PRIOR_FACTORS = (0.1, 10.0)
_STEPS_BETWEEN = 2
_DAMPING = 1e-9
_GROUPS = ("horizontal", "vertical", "tilt", "yaw")
_MEDIAN_LENGTH = float(np.sqrt(np.log(4.0)))  # of residuals (2,) with a deviation of 1 each


@dataclass(frozen=True)
class Priors:
    """What is believed before the pictures speak, with standard deviations.

    interior_sd (c, 9) in the order of INTERIOR, 0 for what is known. points_m, points_sd_m (p, 3): for
    control points their own; for tie points the ground below, weakly. control (p,): which points are
    control, measured by hand and not bound to the terrain. terrain: a surface that tie points lie on, if
    one is known.
    mounting: what POS and poses differ by in common. trust (f, 6): factors of the pose priors' weights, 1
    but for tags that lie; held (s,): which of the shared unknowns, cameras' numbers before the mounting's,
    keep what they were given as the block does not determine them; both set by the solver.
    """

    poses: Poses
    cameras: tuple[Camera, ...]
    interior_sd: Floats
    points_m: Floats
    points_sd_m: Floats
    control: Bools
    terrain: Terrain | None = None
    mounting: Mounting = NO_MOUNTING
    trust: Floats | None = None
    held: Bools | None = None


@dataclass(frozen=True)
class Bundle:
    """The solution. Covariances are scaled with the estimated variance components.

    points_sd_m: (p, 3), as if poses and cameras were known.
    pose_covariance: (f, 6, 6) of east, north, up (m) and turns about them (rad). interior_sd: (c, 9).
    mounting, mounting_sd: (7,). shared_correlation (s, s), s = 9c + 7: of the cameras' numbers and the
    mounting's; held (s,): which of them the block does not determine. Held numbers keep what they were
    given, and the covariances hold what is not known of them. residual_px: (m, 2) observed minus computed.
    weight: (m,) robust weights, 1 for a good observation. sigma_px: estimated deviation of a tie point's
    image coordinate.
    sigma: estimated deviation over stated deviation per group. reduced: the last normal equations.
    """

    poses: Poses
    cameras: tuple[Camera, ...]
    points_m: Floats
    points_sd_m: Floats
    pose_covariance: Floats
    interior_sd: Floats
    mounting: Floats
    mounting_sd: Floats
    shared_correlation: Floats
    held: Bools
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
    mounting: Floats
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
        lenses, points and variance components to go on from.
    Raises: NotSolvableError if the system is singular.
    """
    state = _State(
        start.positions_m.copy(),
        start.rotations.copy(),
        np.stack([interior_of(c) for c in (again.cameras if again else priors.cameras)]),
        again.points_m if again else priors.points_m,
        again.mounting if again else np.zeros(len(MOUNTING)),
    )
    length = _lengths_px(tracks, camera_of, priors, state)
    control = priors.control[tracks.point]
    sigma = dict.fromkeys(_GROUPS, 1.0) | {
        "image": max(sigma_px, _median(length[~control])),
        "control": max(MEASURED_SD_PX, _median(length[control])),
    }
    sigma |= again.sigma if again else {}
    held = np.zeros(_shared_miss(priors, state).size, dtype=bool)
    iterations = 0
    while True:
        priors = replace(priors, held=held)
        state, priors, used = _settle(tracks, camera_of, priors, state, sigma, most)
        iterations += used
        bundle = _finish(tracks, camera_of, priors, state, sigma, iterations)
        held = bundle.held | undetermined(bundle, priors)
        if np.array_equal(held, bundle.held):
            return bundle
        given = np.stack([interior_of(c) for c in priors.cameras])
        state = replace(
            state,
            interior=np.where(held[: given.size].reshape(given.shape), given, state.interior),
            mounting=np.where(held[given.size :], 0.0, state.mounting),
        )


def _settle(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: _State, sigma: dict[str, float], most: int
) -> tuple[_State, Priors, int]:
    """Iterates until unknowns, trust and variance components (in place) stand; the steps it took."""
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
    return state, priors, iterations + used


def undetermined(bundle: Bundle, priors: Priors) -> Bools:
    """Which shared unknowns the block does not determine, (s,): worst first, until all others are.

    A number counts as determined if its deviation is below _DETERMINED of what it was before the pictures
    spoke. To hold the others costs next to nothing, and says so.
    """
    sd = np.concatenate([priors.interior_sd.ravel(), priors.mounting.sd])
    free = np.flatnonzero(sd > 0.0)
    after = np.concatenate([bundle.interior_sd.ravel(), bundle.mounting_sd])[free]
    relative = after / sd[free]
    covariance = bundle.shared_correlation[np.ix_(free, free)] * relative[:, None] * relative
    told = np.linalg.inv(covariance) - np.eye(len(free))
    out, left = np.zeros(sd.size, dtype=bool), np.arange(len(free))
    while left.size:
        share = np.sqrt(np.diag(np.linalg.inv(told[np.ix_(left, left)] + np.eye(left.size))))
        worst = int(share.argmax())
        if share[worst] < _DETERMINED:
            break
        out[free[left[worst]]] = True
        left = np.delete(left, worst)
    return out


def _pose_sd(priors: Priors, sigma: dict[str, float]) -> Floats:
    """Deviations of the pose priors with their present factors, (f, 6); inf where nothing is known."""
    position, turn = priors.poses.positions_sd_m, priors.poses.rotations_sd_rad
    factor = np.array([sigma[g] for g in ("horizontal", "horizontal", "vertical", "tilt", "tilt", "yaw")])
    sd = np.column_stack([position, turn]) * factor
    return np.asarray(np.where(np.isfinite(sd), sd, np.inf))


def _pose_miss(priors: Priors, state: _State) -> Floats:
    """Told minus what present poses and mounting make of it, (f, 6)."""
    return pose_miss(priors.poses, state.positions, state.rotations, state.mounting)


def _shared_sd(priors: Priors) -> Floats:
    """Prior deviations of the shared unknowns, (s,): next to nothing for those that are known or held."""
    sd = np.concatenate([priors.interior_sd.ravel(), priors.mounting.sd])
    known = (sd == 0.0) if priors.held is None else (sd == 0.0) | priors.held
    return np.where(known, _KNOWN * np.where(sd == 0.0, 1.0, sd), sd)


def _shared_miss(priors: Priors, state: _State) -> Floats:
    """Given minus present, (s,)."""
    given = np.stack([interior_of(c) for c in priors.cameras])
    return np.concatenate([(given - state.interior).ravel(), -state.mounting])


def _cost(tracks: Tracks, camera_of: Ints, priors: Priors, state: _State, sigma: dict[str, float]) -> float:
    length = _lengths_px(tracks, camera_of, priors, state) / _image_sd_px(tracks, priors, sigma)
    total = cauchy_cost(np.where(np.isfinite(length), length, 1e6))
    total += float((_trust_of(priors) * (_pose_miss(priors, state) / _pose_sd(priors, sigma)) ** 2).sum())
    total += float(((_shared_miss(priors, state) / _shared_sd(priors)) ** 2).sum())
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
    """Weights of each frame's position and attitude, (f, 6): a wild tag loses its say.

    A frame is wild against the bulk of the others, never all at once: else a whole block that shrinks
    or tips over would free itself from its positions.
    """
    miss = _pose_miss(priors, state) / _pose_sd(priors, sigma)
    length = np.sqrt(np.add.reduceat(miss**2, [0, 3], axis=1))
    bulk = np.maximum(1.0, np.median(length, axis=0) / 1.5)
    return np.repeat(lie_weight(length / bulk), 3, axis=1)


def _trust_of(priors: Priors) -> Floats:
    return np.ones((len(priors.poses), 6)) if priors.trust is None else priors.trust


def _observed(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: _State
) -> tuple[Floats, Floats, Floats, Floats, Floats | None]:
    """What `project` and `image_from_ground` take, a row an observation."""
    camera, velocities = camera_of[tracks.frame], priors.poses.velocities_m_per_s
    heights = np.array([c.height_px for c in priors.cameras])[camera]
    return (
        state.positions[tracks.frame],
        state.rotations[tracks.frame],
        state.interior[camera],
        state.points[tracks.point],
        passing(
            velocities[tracks.frame] if velocities is not None and _rolls(priors) else None,
            tracks.image_px[:, 1],
            heights,
        ),
    )


def _rolls(priors: Priors) -> bool:
    """Whether any camera reads its rows one after the other, or may."""
    readout = INTERIOR.index("readout_s")
    return bool(priors.interior_sd[:, readout].any()) or any(c.readout_s for c in priors.cameras)


def _lengths_px(tracks: Tracks, camera_of: Ints, priors: Priors, state: _State) -> Floats:
    """Lengths of the image residuals, (m,); NaN behind the camera."""
    image = image_from_ground(*_observed(tracks, camera_of, priors, state))
    return np.asarray(np.linalg.norm(tracks.image_px - image, axis=1))


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
    sd_px = _image_sd_px(tracks, priors, sigma)

    def linearised(which: Ints) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        some = Tracks(tracks.frame[which], tracks.point[which], tracks.image_px[which])
        image, by_pose, by_interior, by_point = project(*_observed(some, camera_of, priors, state))
        residual, sd = some.image_px - image, sd_px[which]
        seen = np.isfinite(residual).all(axis=1)
        weight = np.where(seen, cauchy_weight(np.linalg.norm(residual, axis=1) / sd) / sd**2, 0.0)
        for a in (residual, by_pose, by_interior, by_point):
            a[~seen] = 0.0
        return residual, weight, by_pose, by_interior, by_point

    counts = (len(state.positions), *state.interior.shape, len(state.points))
    n = build_normals(tracks.frame, tracks.point, camera_of, counts, linearised)
    n = _with_priors(n, priors, state, sigma)
    if priors.terrain is None:
        return replace(n, level=1.0)
    share = _frame_share(tracks, state)
    return add_terrain(n, priors.terrain, ~priors.control, state.points, state.positions, share, state.level)


def _with_priors(n: Normals, priors: Priors, state: _State, sigma: dict[str, float]) -> Normals:
    """Adds what was believed of poses, points, lenses and mounting."""
    by_pose, by_mounting = mounting_derivatives(priors.poses, state.rotations, state.mounting)
    weighted = (_trust_of(priors) / _pose_sd(priors, sigma) ** 2)[:, :, None]
    miss = _pose_miss(priors, state)[:, :, None]
    back = np.swapaxes(by_pose, 1, 2)
    n.pose[:] += back @ (weighted * by_pose)
    n.pose_side[:] += (back @ (weighted * miss))[:, :, 0]
    n.points[:, [0, 1, 2], [0, 1, 2]] += 1.0 / priors.points_sd_m**2
    n.point_side[:] += (priors.points_m - state.points) / priors.points_sd_m**2
    weight, off = 1.0 / _shared_sd(priors) ** 2, _shared_miss(priors, state)
    c, k = state.interior.shape
    i = np.arange(k)
    n.interior[:, i, i] += weight[: c * k].reshape(c, k)
    n.interior_side[:] += (weight * off)[: c * k].reshape(c, k)
    if not priors.mounting.asked.any():
        return n
    return replace(
        n,
        pose_mounting=back @ (weighted * by_mounting),
        mounting=np.einsum("fai,faj->ij", by_mounting, weighted * by_mounting) + np.diag(weight[c * k :]),
        mounting_side=np.einsum("fai,fa->i", by_mounting, (weighted * miss)[:, :, 0])
        + (weight * off)[c * k :],
    )


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
            pose, interior, point, level, mounting = reduce_normals(normals, damping).solve()
            trial = _State(
                state.positions + pose[:, :3],
                exp_turn(pose[:, 3:]) @ state.rotations,
                state.interior + interior,
                state.points + point,
                state.mounting + mounting if mounting.size else state.mounting,
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
    length_px = _lengths_px(tracks, camera_of, priors, state)
    before = sigma["image"], sigma["control"]
    if not control.all():
        length = np.nan_to_num(length_px[~control] / sigma["image"], nan=1e6)
        robust = cauchy_weight(length)
        settled = float(share.sum()) + surface_share(n, reduced.points_inverse)
        known = np.diag(shared)[: state.interior.size] / _shared_sd(priors)[: state.interior.size] ** 2
        settled += float(known.sum())
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
        sigma[group] = float(np.clip(_believed(factor * np.sqrt(total / r), r), *_PRIOR_FACTORS))
        changes.append(float(abs(np.log(sigma[group] / factor))))
    return image_changed, max(changes)


def _believed(factor: float, redundancy: float) -> float:
    """A factor estimated from so many redundant observations, drawn to 1 where it may as well be chance.

    Its logarithm is weighed with the probability that the stated deviation is wrong, by Schwarz's
    approximation (1978) of the evidence: of 48 observations a factor of 1.1 is chance, one of 1.5 is not.
    Else the covariance of a small block with rightly stated deviations would follow their draw.
    """
    variance = max(factor**2, 1e-6)
    evidence = redundancy / 2.0 * (variance - 1.0 - np.log(variance))
    wrong = 1.0 / (1.0 + np.sqrt(redundancy) * np.exp(-min(evidence, 500.0)))
    return float(np.exp(wrong * np.log(variance) / 2.0))


def _finish(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: _State, sigma: dict[str, float], iterations: int
) -> Bundle:
    reduced = reduce_normals(_normals(tracks, camera_of, replace(priors, held=None), state, sigma))
    covariance, shared = reduced.covariance()
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    image = image_from_ground(*_observed(tracks, camera_of, priors, state))
    residual = tracks.image_px - image
    cameras, mounting = state.interior.size, state.mounting.size
    solved = np.r_[0:cameras, cameras + 1 : len(shared)]
    full = np.eye(cameras + mounting) * _KNOWN**2
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
