"""The equations of a bundle: its cost and its normal equations at the present state."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.problem.bundle_model import READOUT, Factors, Priors, State
from geomosaic.adjustment.problem.tracks import Tracks, part_of
from geomosaic.adjustment.solver.normal_equations import Normals, build_normals
from geomosaic.adjustment.solver.observation_groups import AT_ONCE
from geomosaic.adjustment.terms.collinearity import (
    INTERIOR,
    image_from_ground,
    interior_of,
    kinds_of,
    project_by_levers,
    readout_of,
)
from geomosaic.adjustment.terms.mounting import mounting_derivatives, pose_miss
from geomosaic.adjustment.terms.pose_jacobian import Levers
from geomosaic.adjustment.terms.terrain import add_terrain, terrain_cost
from geomosaic.constants import tuned
from geomosaic.estimation.robust import INFORMATION, student_cost, student_weight
from geomosaic.survey.plausible import OFF_CENTRE

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
PRINCIPAL = [INTERIOR.index(name) for name in ("principal_col_px", "principal_row_px")]
KNOWN = tuned(
    1e-6,
    "px, rad, m or s, or share of a deviation",
    "prior deviation of what is known or held: next to nothing; with 0 the equations could not be solved",
)
BEHIND = tuned(1e6, "deviations", "of an image behind its camera: farther off than any that is before it")


def cost_of(tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors) -> float:
    shown = share_shown(tracks, priors)
    length = lengths_px(tracks, camera_of, priors, state)
    length /= image_sd_px(tracks, priors, factors) * np.sqrt(shown)
    cost = shown * student_cost(np.where(np.isfinite(length), length, BEHIND))
    total = float(cost[has_say(tracks, priors)].sum())
    total += float((trust_of(priors) * (present_miss(priors, state) / pose_sd(priors, factors)) ** 2).sum())
    total += float(((shared_miss(priors, state) / shared_sd(priors)) ** 2).sum())
    total += float((((priors.points_m - state.points) / points_sd(priors, factors)) ** 2).sum())
    total += float(((while_read(state) / while_read_sd(priors, factors)) ** 2).sum())
    if priors.terrain is not None:
        total += terrain_cost(
            priors.terrain,
            ~priors.control,
            state.points,
            state.positions,
            frame_share(tracks, state),
            state.level,
        )
    return total


def normals_of(tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors) -> Normals:
    """Those of Fisher's scoring: weights are what image errors are expected to contribute."""
    sd_px, shown = image_sd_px(tracks, priors, factors), share_shown(tracks, priors)
    seen = seen_px(tracks, camera_of, priors, state)

    def linearised(which: Ints) -> tuple[Floats, Floats, Levers, Floats, Floats]:
        some = part_of(tracks, which)
        here = in_own_rows(some, camera_of, priors, state, seen[which])
        image, levers, by_interior, by_point = project_by_levers(*here)
        residual, sd = some.image_px.T - image, sd_px[which]
        counts = np.isfinite(residual).all(axis=0) & has_say(some, priors)
        length = np.linalg.norm(residual, axis=0) / (sd * np.sqrt(shown[which]))
        weight = np.where(counts, student_weight(length) / sd**2, 0.0)
        residual /= INFORMATION
        for a in (residual, levers.arms_m, by_interior, by_point):
            a[..., ~counts] = 0.0
        return residual, weight, levers, by_interior, by_point

    sightings = tracks.sightings(len(state.positions), len(state.points))
    terms = 0 if state.swing is None else state.swing.shape[1]
    n = build_normals(sightings, camera_of, state.interior.shape, linearised, terms)
    n = _with_priors(n, camera_of, priors, state, factors)
    if priors.terrain is None:
        return replace(n, level=1.0)
    share = frame_share(tracks, state)
    return add_terrain(n, priors.terrain, ~priors.control, state.points, state.positions, share, state.level)


def _with_priors(n: Normals, camera_of: Ints, priors: Priors, state: State, factors: Factors) -> Normals:
    """Adds what was believed of poses, points, lenses and mounting."""
    by_pose, by_mounting = mounting_derivatives(priors.poses, state.rotations, state.mounting)
    weighted = (trust_of(priors) / pose_sd(priors, factors) ** 2)[:, :, None]
    miss = present_miss(priors, state)[:, :, None]
    back = np.swapaxes(by_pose, 1, 2)
    n.pose[:, :6, :6] += back @ (weighted * by_pose)
    n.pose_side[:, :6] += (back @ (weighted * miss))[:, :, 0]
    sd, i = while_read_sd(priors, factors), np.arange(6, n.pose.shape[1])
    n.pose[:, i, i] += 1.0 / sd**2
    n.pose_side[:, 6:] -= while_read(state) / sd**2
    point_sd = points_sd(priors, factors)
    n.points[:, [0, 1, 2], [0, 1, 2]] += 1.0 / point_sd**2
    n.point_side[:] += (priors.points_m - state.points) / point_sd**2
    weight, off = 1.0 / shared_sd(priors) ** 2, shared_miss(priors, state)
    c, k = state.interior.shape
    i = np.arange(k)
    n.interior[:, i, i] += weight[: c * k].reshape(c, k)
    n.interior_side[:] += (weight * off)[: c * k].reshape(c, k)
    if not priors.mounting.asked.any():
        return n
    return replace(
        n,
        pose_mounting=np.pad(back @ (weighted * by_mounting), ((0, 0), (0, n.pose.shape[1] - 6), (0, 0))),
        mounting=np.einsum("fai,faj->ij", by_mounting, weighted * by_mounting) + np.diag(weight[c * k :]),
        mounting_side=np.einsum("fai,fa->i", by_mounting, (weighted * miss)[:, :, 0])
        + (weight * off)[c * k :],
    )


def pose_sd(priors: Priors, factors: Factors) -> Floats:
    """Deviations of the pose priors with their present factors, (f, 6); inf where nothing is known."""
    sd = np.column_stack([priors.poses.positions_sd_m, priors.poses.rotations_sd_rad]) * factors.by_column
    return np.asarray(np.where(np.isfinite(sd), sd, np.inf))


def points_sd(priors: Priors, factors: Factors) -> Floats:
    """Deviations (p, 3) of the points' priors: of control with its component, and larger where a point has
    less say."""
    say = 1.0 if priors.control_say is None else priors.control_say
    return priors.points_sd_m * np.where(priors.control[:, None], factors.of_control, 1.0) / np.sqrt(say)


def while_read(state: State) -> Floats:
    """What frames do while their rows are read, beside what is given of it: swings in rad, function by
    function, and last the drift in m, (f, 3 t + 3), or (f, 0) where all rows are read at once."""
    if state.swing is None or state.drift_m is None:
        return np.zeros((len(state.positions), 0))
    return np.column_stack([state.swing.reshape(len(state.swing), -1), state.drift_m])


def while_read_sd(priors: Priors, factors: Factors) -> Floats:
    """Deviations of `while_read` with their present components."""
    if priors.swing_sd_rad is None or priors.drift_sd_m is None:
        return np.zeros((len(priors.poses), 0))
    *of_swing, along, up = factors.while_read
    swing_sd = priors.swing_sd_rad * np.reshape(of_swing, (-1, 1))
    drift_sd = priors.drift_sd_m * [along, along, up]
    return np.column_stack([swing_sd.reshape(len(drift_sd), -1), drift_sd])


def present_miss(priors: Priors, state: State) -> Floats:
    """Given minus what present poses and mounting make of it, (f, 6)."""
    return pose_miss(priors.poses, state.positions, state.rotations, state.mounting)


def shared_sd(priors: Priors) -> Floats:
    """Prior deviations of the shared unknowns, (s,): next to nothing for those that are known or held."""
    sd = np.concatenate([priors.interior_sd.ravel(), priors.mounting.sd])
    return np.where(known(priors), KNOWN * np.where(sd == 0.0, 1.0, sd), sd)


def known(priors: Priors) -> Bools:
    """Which shared unknowns are known or held, (s,)."""
    sd = np.concatenate([priors.interior_sd.ravel(), priors.mounting.sd])
    return np.asarray((sd == 0.0) if priors.held is None else (sd == 0.0) | priors.held)


def shared_miss(priors: Priors, state: State) -> Floats:
    """Given minus present, (s,)."""
    given = np.stack([interior_of(c) for c in priors.cameras])
    return np.concatenate([(given - state.interior).ravel(), -state.mounting])


def strayed_principal_points(priors: Priors, state: State) -> Bools:
    """Both coordinates of principal points that no lens has so far from where they were given, (s,)."""
    off_px = shared_miss(priors, state)[: state.interior.size].reshape(state.interior.shape)[:, PRINCIPAL]
    longer_px = np.array([max(c.width_px, c.height_px) for c in priors.cameras])
    out = np.zeros((*state.interior.shape,), dtype=bool)
    out[:, PRINCIPAL] = (np.linalg.norm(off_px, axis=1) > OFF_CENTRE.value * longer_px)[:, None]
    return np.concatenate([out.ravel(), np.zeros(state.mounting.size, dtype=bool)])


def trust_of(priors: Priors) -> Floats:
    return np.ones((len(priors.poses), 6)) if priors.trust is None else priors.trust


def in_own_rows(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, seen_at_px: Floats
) -> tuple[Any, ...]:
    """`observed` with rolling shutters at the points' own rows, see `Readout`; seen_at_px (m, 2): where the
    points are seen while the measured rows are read."""
    if not _reads_rows(priors, state):
        return observed(tracks, camera_of, priors, state)
    heights = np.array([c.height_px for c in priors.cameras])[camera_of[tracks.frame]]
    rows = np.clip(seen_at_px[:, 1], 0.0, heights)
    return observed(tracks, camera_of, priors, state, np.where(np.isnan(rows), tracks.image_px[:, 1], rows))


def seen_px(tracks: Tracks, camera_of: Ints, priors: Priors, state: State) -> Floats:
    """Where the points are seen while the measured rows are read, (m, 2); NaN behind the camera. The state
    keeps them: cost, equations and variance components all ask."""
    if state.seen_px is None:
        parts = np.array_split(np.arange(len(tracks.frame)), max(len(tracks.frame) // AT_ONCE, 1))
        state.seen_px = np.concatenate(
            [image_from_ground(*observed(part_of(tracks, i), camera_of, priors, state)) for i in parts]
        )
    return state.seen_px


def observed(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, rows_px: Floats | None = None
) -> tuple[Any, ...]:
    """What `project` and `image_from_ground` take, a row an observation; shutters at rows_px (m,), or the
    measured rows."""
    camera, frame = camera_of[tracks.frame], tracks.frame
    interior, kinds = state.interior[camera], kinds_of(priors.cameras)
    seen = state.positions[frame], state.rotations[frame], interior, state.points[tracks.point]
    kind = None if kinds is None else kinds[camera]
    if not _reads_rows(priors, state):
        return *seen, None, kind
    heights = np.array([c.height_px for c in priors.cameras])[camera]
    rows = tracks.image_px[:, 1] if rows_px is None else rows_px
    read = readout_of(
        *(priors.poses, state.rotations, state.swing, state.drift_m),
        *(frame, rows, heights, interior[:, READOUT]),
    )
    return seen[0], read.rotations, *seen[2:], read, kind


def _reads_rows(priors: Priors, state: State) -> bool:
    """Whether rows make a difference."""
    moving = priors.poses.velocities_m_per_s is not None or priors.poses.turns is not None
    return _rolls(priors) and (moving or state.swing is not None)


def _rolls(priors: Priors) -> bool:
    """Whether any camera reads its rows one after the other, or may."""
    return bool(priors.interior_sd[:, READOUT].any()) or any(c.readout_s for c in priors.cameras)


def longest_side_px(priors: Priors) -> float:
    """Of all cameras' images: no image deviation is larger."""
    return float(max(max(c.width_px, c.height_px) for c in priors.cameras))


def lengths_px(tracks: Tracks, camera_of: Ints, priors: Priors, state: State) -> Floats:
    """Lengths of the image residuals, (m,); NaN behind the camera."""
    away = tracks.image_px - seen_px(tracks, camera_of, priors, state)
    return np.asarray(np.hypot(away[:, 0], away[:, 1]))


def image_sd_px(tracks: Tracks, priors: Priors, factors: Factors) -> Floats:
    """Present deviation of each observation, (m,): hand-measured control apart from tie points."""
    return np.where(
        priors.control[tracks.point], factors.control_px, factors.image_px * unrest_of(tracks, priors)
    )


def unrest_of(tracks: Tracks, priors: Priors) -> Floats:
    """Factor of each observation's deviation, (m,)."""
    return np.ones(len(tracks.point)) if priors.unrest is None else priors.unrest[tracks.point]


def share_shown(tracks: Tracks, priors: Priors) -> Floats:
    """The share of an error's square that residuals show along the directions in which they do, (m,).

    A point's place takes three of the two numbers that each of its k images gives: residuals are shorter than
    errors, and stand out as such only (Baarda 1968, section 4). Those of a point seen twice have one
    direction, across the plane of both rays, and half of the square in it.
    """
    views = tracks.lengths[tracks.point]
    return np.where(priors.control[tracks.point], 1.0, 1.0 - 1.5 / np.maximum(views, 3))


def has_say(tracks: Tracks, priors: Priors) -> NDArray[np.bool_]:
    """Which observations count, (m,): those of frames that weren't left out."""
    return (
        np.ones(len(tracks.frame), dtype=bool) if priors.left_out is None else ~priors.left_out[tracks.frame]
    )


def frame_share(tracks: Tracks, state: State) -> Floats:
    """Each frame's share of the observations, (f,)."""
    return np.bincount(tracks.frame, minlength=len(state.positions)) / max(len(tracks.frame), 1)
