"""The collinearity equations over many observations at once, with analytic derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.swing import terms_at
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import LENSES, TERMS, Lens
from geomosaic.camera.rotation import exp_turn

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

INTERIOR = (
    "focal_length_px",
    "principal_col_px",
    "principal_row_px",
    *TERMS,
    "readout_s",
)


def interior_of(camera: Camera) -> Floats:
    """A camera's numbers in the order of INTERIOR, (9,)."""
    return np.array([getattr(camera, name) for name in INTERIOR])


def image_from_ground(
    positions_m: Floats,
    rotations: Floats,
    interior: Floats,
    points_m: Floats,
    passing_m_per_s: Floats | None = None,
    kinds: Ints | None = None,
    turning_rad_per_s: Floats | None = None,
    terms: Floats | None = None,
) -> Floats:
    """Image coordinates (m, 2) as `project` gives them, without derivatives."""
    _, u, v, _ = _directions(positions_m, rotations, interior, points_m, passing_m_per_s)
    bent = np.empty((len(u), 2))
    for lens, which in _lenses(kinds):
        x, y = u[which], v[which]
        bent[which] = np.stack(lens.bent(interior[which, 3:8].T, x, y, x * x + y * y), axis=-1)
    return bent * interior[:, :1] + interior[:, 1:3]


def project(
    positions_m: Floats,
    rotations: Floats,
    interior: Floats,
    points_m: Floats,
    passing_m_per_s: Floats | None = None,
    kinds: Ints | None = None,
    turning_rad_per_s: Floats | None = None,
    terms: Floats | None = None,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Image coordinates and their derivatives, one row an observation.

    See `Camera` and `Rotation` for the equations. A rotation's update is a small turn about the work
    frame's axes from the left, R = exp([t]) R0.

    Args: positions_m (m, 3), rotations (m, 3, 3), interior (m, 9) in the order of INTERIOR,
        points_m (m, 3). passing_m_per_s, turning_rad_per_s (m, 3): see `Readout`, whose rotations are to be
        given with them. kinds (m,): of lenses, see `kinds_of`. terms (m, t): functions of the row by which
        frames swing, see `swing`, where their factors are unknown.
    Returns: image_px (m, 2); by_pose (m, 2, 6 + 3 t): position, turn in rad, and each function's factors
        about the work frame's axes; by_interior (m, 2, 9); by_point (m, 2, 3). NaN behind the camera.
    """
    d, u, v, z = _directions(positions_m, rotations, interior, points_m, passing_m_per_s)
    f = interior[:, 0]
    bent, slopes = np.empty((2, len(u))), np.empty((3, len(u)))
    by_interior = np.zeros((len(u), 2, len(INTERIOR)))
    for lens, which in _lenses(kinds):
        x, y = u[which], v[which]
        r_sq, bends = x * x + y * y, interior[which, 3:8].T
        bent[:, which] = lens.bent(bends, x, y, r_sq)
        slopes[:, which] = lens.slopes(bends, x, y, r_sq)
        for column, (across, down) in enumerate(lens.by_terms(x, y, r_sq), 3):
            by_interior[which, 0, column] = f[which] * across
            by_interior[which, 1, column] = f[which] * down
    image = (bent * f).T + interior[:, 1:3]
    by_u, by_v = slopes[:2], slopes[1:]
    by_camera = np.empty((len(u), 2, 3))
    for axis in range(2):
        by_camera[:, axis, 0] = -by_u[axis]
        by_camera[:, axis, 1] = by_v[axis]
        by_camera[:, axis, 2] = -(by_u[axis] * u + by_v[axis] * v)
    by_camera *= (f / z)[:, None, None]
    by_point = by_camera @ np.swapaxes(rotations, 1, 2)
    by_pose = np.empty((len(u), 2, 6 + 3 * (0 if terms is None else terms.shape[1])))
    np.negative(by_point, out=by_pose[:, :, :3])
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        by_pose[:, :, 3 + axis] = (
            by_point[:, :, one] * d[:, two, None] - by_point[:, :, two] * d[:, one, None]
        )
    if terms is not None:
        swung = terms[:, None, :, None] * by_pose[:, :, None, 3:6]
        by_pose[:, :, 6:] = swung.reshape(len(u), 2, -1)
    by_interior[:, :, 0] = bent.T
    by_interior[:, 0, 1] = by_interior[:, 1, 2] = 1.0
    if passing_m_per_s is not None:
        by_interior[:, :, 8] = -np.einsum("maj,mj->ma", by_point, passing_m_per_s)
    if turning_rad_per_s is not None:
        by_interior[:, :, 8] += np.einsum("maj,mj->ma", by_pose[:, :, 3:6], turning_rad_per_s)
    return image, by_pose, by_interior, by_point


def _directions(
    positions_m: Floats, rotations: Floats, interior: Floats, points_m: Floats, passing_m_per_s: Floats | None
) -> tuple[Floats, Floats, Floats, Floats]:
    """Point minus projection centre (m, 3); to the right and down in the picture over the distance along the
    view, without distortion, (m,) each; and the camera's own z (m,), NaN behind the camera."""
    d = points_m - positions_m
    if passing_m_per_s is not None:
        d = d - interior[:, 8:] * passing_m_per_s
    x, y, z = np.einsum("mij,mi->jm", rotations, d)
    z = np.where(z < 0.0, z, np.nan)
    return d, -x / z, y / z, z


def kinds_of(cameras: Sequence[Camera]) -> Ints | None:
    """Numbers of the cameras' kinds of lens in `lens.LENSES`, None if all have the first one."""
    names = list(LENSES)
    kinds = np.array([names.index(c.kind) for c in cameras], dtype=np.intp)
    return kinds if kinds.any() else None


def _lenses(kinds: Ints | None) -> list[tuple[Lens, Ints | slice]]:
    """The lenses that occur, each with the rows it bends."""
    lenses = list(LENSES.values())
    if kinds is None:
        return [(lenses[0], slice(None))]
    return [(lenses[k], np.flatnonzero(kinds == k)) for k in np.unique(kinds)]


@dataclass(frozen=True)
class Readout:
    """What rolling shutters make of the poses of m observations, by their rows as measured.

    rotations (m, 3, 3): as they were when each row was read. terms (m, t): functions of the row by which
    frames swing.
    passed_m_per_s, turned_rad_per_s (m, 3): by what the projection centre moves and the camera turns, in the
    work frame, for each second of readout until then.
    """

    rotations: Floats
    terms: Floats | None
    passed_m_per_s: Floats
    turned_rad_per_s: Floats | None


def readout_of(
    poses: Poses,
    rotations: Floats,
    swing_rad: Floats | None,
    frame: Ints,
    row_px: Floats,
    heights_px: Floats,
    readouts_s: Floats,
) -> Readout:
    """Of observations (m,) in frames with present rotations (f, 3, 3), by their rows, heights of their
    pictures and readout times, (m,) each.

    swing_rad (f, t, 3): factors of the functions of the row about the work frame's axes, on top of the poses'
    own turns: `R(row) = exp(swing(row)) R exp(turn(row))`.
    """
    share = row_px / heights_px - 0.5
    after_s, at_row = share * readouts_s, rotations[frame]
    passed, turned = np.zeros((len(frame), 3)), None
    if poses.velocities_m_per_s is not None:
        passed = poses.velocities_m_per_s[frame] * share[:, None]
    if poses.turns is not None:
        turn, rate = poses.turns.at(after_s, frame)
        at_row = at_row @ exp_turn(turn)
        rate = rate - 0.5 * np.cross(turn, rate)
        turned = np.einsum("mij,mj->mi", at_row, rate) * share[:, None]
    terms = None
    if swing_rad is not None:
        terms = terms_at(share, swing_rad.shape[1])
        more = exp_turn(np.einsum("mt,mtj->mj", terms, swing_rad[frame]))
        at_row = more @ at_row
        turned = None if turned is None else np.einsum("mij,mj->mi", more, turned)
    return Readout(at_row, terms, passed, turned)
