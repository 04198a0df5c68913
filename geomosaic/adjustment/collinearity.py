"""The collinearity equations over many observations at once, with analytic derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.swing import recorded_share, terms_at
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import LENSES, TERMS, Lens
from geomosaic.camera.rotation import exp_turn
from geomosaic.constants import CHOSEN, Because

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


_MOST_BY_ROW: Annotated[
    float,
    Because(
        "rows a row",
        "by which a frame is stretched while it is read: one of twice or two thirds of its height is no "
        "image",
        CHOSEN,
    ),
] = 0.5


@dataclass(frozen=True)
class Readout:
    """What rolling shutters make of m observations, each while a row about its own is read.

    A measured row is off by a keypoint's error. Residuals against where a point is seen while that row is
    read would shrink by as much as rows are stretched, and thousands of them would stretch every frame: so
    residuals are those at a point's own row, where it is seen while that row is read. Nor may derivatives
    know of the error: they are taken at the point's own row.

    rows_px, heights_px (m,): the rows, and heights of the images. rotations (m, 3, 3): as they were when
    each row was read. velocities_m_per_s, rates_rad_per_s (m, 3): of the projection centre, and of what is
    given of the camera's turning, in the work frame. terms (m, t): functions of the row by which frames
    swing, swinging_rad (m, 3): by how much these turn over a whole height at the present rate.
    """

    rows_px: Floats
    heights_px: Floats
    rotations: Floats
    velocities_m_per_s: Floats
    rates_rad_per_s: Floats
    terms: Floats | None
    swinging_rad: Floats

    @property
    def shares(self) -> Floats:
        """Of the image's height, from its middle row on, (m, 1)."""
        return (self.rows_px / self.heights_px - 0.5)[:, None]

    @property
    def passed_m_per_s(self) -> Floats:
        """By what the projection centre has moved for each second of readout, (m, 3)."""
        return self.velocities_m_per_s * self.shares

    @property
    def turned_rad_per_s(self) -> Floats:
        """By what the camera has turned for each second of readout, (m, 3)."""
        return self.rates_rad_per_s * self.shares

    def seen_px(self, image_px: Floats, by_row: Floats) -> Floats:
        """Where points are seen (m, 2) that would be at image_px while these rows are read."""
        rows = (image_px[:, 1] - self.rows_px) / (1.0 - by_row[:, 1])
        return np.stack([image_px[:, 0] + by_row[:, 0] * rows, self.rows_px + rows], axis=1)


def readout_of(
    poses: Poses,
    rotations: Floats,
    swing: Floats | None,
    frame: Ints,
    rows_px: Floats,
    heights_px: Floats,
    readouts_s: Floats,
) -> Readout:
    """Of observations (m,) in frames with present rotations (f, 3, 3), by their rows, heights of their
    images and readout times, (m,) each.

    swing (f, t, 3): factors of the functions of the row about the work frame's axes, on top of the poses' own
    turns: `R(row) = exp(swing(row)) R exp(turn(row))`.
    """
    share, none = rows_px / heights_px - 0.5, np.zeros((len(frame), 3))
    at_row, rates, terms, swinging = rotations[frame], none, None, none
    velocities = none if poses.velocities_m_per_s is None else poses.velocities_m_per_s[frame]
    if poses.turns is not None:
        turn, rate = poses.turns.at(share * readouts_s, frame)
        at_row = at_row @ exp_turn(turn)
        rates = np.einsum("mij,mj->mi", at_row, rate - 0.5 * np.cross(turn, rate))
    if swing is not None:
        recorded = recorded_share(poses.turns, frame, readouts_s)
        terms, slopes = terms_at(share, swing.shape[1], recorded, readouts_s < 0.0)
        more = exp_turn(np.einsum("mt,mtj->mj", terms, swing[frame]))
        swinging = np.einsum("mt,mtj->mj", slopes, swing[frame])
        at_row = more @ at_row
        rates = np.einsum("mij,mj->mi", more, rates)
    return Readout(rows_px, heights_px, at_row, velocities, rates, terms, swinging)


def image_from_ground(
    positions_m: Floats,
    rotations: Floats,
    interior: Floats,
    points_m: Floats,
    read: Readout | None = None,
    kinds: Ints | None = None,
) -> Floats:
    """Image coordinates (m, 2) as `project` gives them, without derivatives."""
    d, u, v, z = _directions(positions_m, rotations, interior, points_m, read)
    bent, slopes = _bends(u, v, interior, kinds, slopes=read is not None)
    image = (bent * interior[:, 0]).T + interior[:, 1:3]
    if read is not None:
        by_row = _by_row(read, rotations, interior, d, u, v, z, slopes)
        image = read.seen_px(image, by_row)
    return image


def project(
    positions_m: Floats,
    rotations: Floats,
    interior: Floats,
    points_m: Floats,
    read: Readout | None = None,
    kinds: Ints | None = None,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Image coordinates and their derivatives, one row an observation.

    See `Camera` and `Rotation` for the equations. A rotation's update is a small turn about the work
    frame's axes from the left, R = exp([t]) R0.

    Args: positions_m (m, 3), rotations (m, 3, 3), interior (m, 9) in the order of INTERIOR,
        points_m (m, 3). read: of rolling shutters, whose rotations are to be given with it; a point is then
        seen in the row that is read while it is seen there, to first order about the rows of `read`.
        kinds (m,): of lenses, see `kinds_of`.
    Returns: image_px (m, 2); by_pose (m, 2, 6 + 3 t): position, turn in rad, and the frame's swing;
        by_interior (m, 2, 9); by_point (m, 2, 3). NaN behind the camera.
    """
    d, u, v, z = _directions(positions_m, rotations, interior, points_m, read)
    f, terms = interior[:, 0], None if read is None else read.terms
    bent, slopes = _bends(u, v, interior, kinds, slopes=True)
    image = (bent * f).T + interior[:, 1:3]
    by_interior = np.zeros((len(u), 2, len(INTERIOR)))
    for lens, which in _lenses(kinds):
        x, y = u[which], v[which]
        for column, (across, down) in enumerate(lens.by_terms(x, y, x * x + y * y), 3):
            by_interior[which, 0, column] = f[which] * across
            by_interior[which, 1, column] = f[which] * down
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
    by_interior[:, :, 0] = bent.T
    by_interior[:, 0, 1] = by_interior[:, 1, 2] = 1.0
    if read is None:
        return image, by_pose, by_interior, by_point
    by_interior[:, :, 8] = -np.einsum("maj,mj->ma", by_point, read.passed_m_per_s)
    by_interior[:, :, 8] += np.einsum("maj,mj->ma", by_pose[:, :, 3:6], read.turned_rad_per_s)
    by_row = _by_row(read, rotations, interior, d, u, v, z, slopes)
    for derivatives in (by_pose[:, :, :6], by_interior, by_point):
        _in_own_row(derivatives, by_row)
    if terms is not None:
        swung = terms[:, None, :, None] * by_pose[:, :, None, 3:6]
        by_pose[:, :, 6:] = swung.reshape(len(u), 2, -1)
    return read.seen_px(image, by_row), by_pose, by_interior, by_point


def _directions(
    positions_m: Floats, rotations: Floats, interior: Floats, points_m: Floats, read: Readout | None
) -> tuple[Floats, Floats, Floats, Floats]:
    """Point minus projection centre (m, 3); to the right and down in the image over the distance along the
    view, without distortion, (m,) each; and the camera's own z (m,), NaN behind the camera."""
    d = points_m - positions_m
    if read is not None:
        d = d - interior[:, 8:] * read.passed_m_per_s
    x, y, z = np.einsum("mij,mi->jm", rotations, d)
    z = np.where(z < 0.0, z, np.nan)
    return d, -x / z, y / z, z


def _bends(
    u: Floats, v: Floats, interior: Floats, kinds: Ints | None, *, slopes: bool
) -> tuple[Floats, Floats]:
    """Directions as the lenses bend them (2, m), and the slopes of that (3, m) if asked for."""
    bent, slope = np.empty((2, len(u))), np.empty((3, len(u) if slopes else 0))
    for lens, which in _lenses(kinds):
        x, y = u[which], v[which]
        r_sq, bends = x * x + y * y, interior[which, 3:8].T
        bent[:, which] = lens.bent(bends, x, y, r_sq)
        if slopes:
            slope[:, which] = lens.slopes(bends, x, y, r_sq)
    return bent, slope


def _by_row(
    read: Readout,
    rotations: Floats,
    interior: Floats,
    d: Floats,
    u: Floats,
    v: Floats,
    z: Floats,
    slopes: Floats,
) -> Floats:
    """By how much points' images move while one row after the other is read, (m, 2) px a row."""
    readout_s = interior[:, 8:]
    turning = readout_s * read.rates_rad_per_s + read.swinging_rad
    moving = -readout_s * read.velocities_m_per_s - np.cross(turning, d)
    x, y, along = np.einsum("mij,mi->jm", rotations, moving)
    du, dv = -(x + u * along) / z, (y - v * along) / z
    moved = np.stack([slopes[0] * du + slopes[1] * dv, slopes[1] * du + slopes[2] * dv], axis=1)
    moved *= (interior[:, 0] / read.heights_px)[:, None]
    return np.asarray(np.clip(moved, -_MOST_BY_ROW, _MOST_BY_ROW))


def _in_own_row(derivatives: Floats, by_row: Floats) -> None:
    """Derivatives (m, 2, k) by which the row itself moves, in place."""
    derivatives[:, 1] /= (1.0 - by_row[:, 1])[:, None]
    derivatives[:, 0] += by_row[:, :1] * derivatives[:, 1]


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
