"""The collinearity equations over many observations at once, with analytic derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from geomosaic.adjustment.kernels.interior import INTERIOR
from geomosaic.adjustment.kernels.pose_jacobian import Levers
from geomosaic.adjustment.kernels.row_functions import recorded_share, terms_at
from geomosaic.arrays import Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import LENSES, Lens
from geomosaic.constants import tuned
from geomosaic.estimation.linear import cross_each, multiply_each

_MOST_BY_ROW = tuned(0.5, "rows a row", "of stretching while a frame is read: more is no image")


@dataclass(frozen=True)
class Readout:
    """Motion of m observations' frames at the rows they lie in.

    Residuals are taken at a point's own row, where it is seen while that row is read. Against the measured
    row they would shrink by the keypoint's error times the stretching of rows, and thousands of them would
    stretch every frame. Derivatives are taken at the point's own row too.

    rows_px, heights_px (m,): rows, heights of the images. rotations (m, 3, 3): at these rows.
    velocities_m_per_s, rates_rad_per_s (m, 3): in the work frame, of the projection centre and of the
    reported rotation. terms (m, t): functions of the row for the rotation about axes (m, 3, 3);
    term_rotation_rad (m, 3): its rate over the image height; drift (m, 3): movement over the image height
    besides the velocity, over the depth, in the work frame.
    """

    rows_px: Floats
    heights_px: Floats
    rotations: Floats
    velocities_m_per_s: Floats
    rates_rad_per_s: Floats
    terms: Floats | None
    axes: Floats
    term_rotation_rad: Floats
    drift: Floats

    @property
    def shares(self) -> Floats:
        """Of the image's height, from its middle row on, (m,)."""
        return self.rows_px / self.heights_px - 0.5

    def seen_px(self, image_px: Floats, by_row: Floats) -> Floats:
        """Image coordinates (2, m) of points that would be at image_px while these rows are read; by_row (2,
        m): by how much they move for each row."""
        rows = (image_px[1] - self.rows_px) / (1.0 - by_row[1])
        return np.stack([image_px[0] + by_row[0] * rows, self.rows_px + rows])


def by_component(values: Floats) -> Floats:
    """(m, ...) as (..., m), each component in one piece: what is done to all m goes through it at once."""
    return np.ascontiguousarray(values.transpose(*range(1, values.ndim), 0))


def _by_number(components: Floats) -> Floats:
    """(..., m) as (m, ...), as it lies."""
    return components.transpose(-1, *range(components.ndim - 1))


def of_each(values: Floats, number: Ints) -> Floats:
    """Those (f, ...) of each observation's frame or camera (m,), (m, ...), each component in one piece."""
    return _by_number(_of_frames(values, number))


def _of_frames(values: Floats, frame: Ints) -> Floats:
    """Those (f, ...) of each observation's frame (m,), by component (..., m)."""
    return by_component(values).take(frame, axis=-1)


@dataclass(frozen=True)
class Rows:
    """Rows of m observations: frame number, row, height of the image in px and readout time, (m,) each."""

    frame: Ints
    rows_px: Floats
    heights_px: Floats
    readouts_s: Floats


@dataclass(frozen=True)
class Projections:
    """m points and the frames that observe them: positions_m (m, 3), rotations (m, 3, 3), interior (m, 9) in
    the order of INTERIOR, points_m (m, 3). read: of rolling shutters; points are then projected to first
    order about its rows. kinds (m,): of lenses, see `kinds_of`."""

    positions_m: Floats
    rotations: Floats
    interior: Floats
    points_m: Floats
    read: Readout | None = None
    kinds: Ints | None = None


def readout_of(
    poses: Poses,
    rotations: Floats,
    rows: Rows,
    rotation_terms: Floats | None = None,
    drift: Floats | None = None,
) -> Readout:
    """Readout of observations in frames with present rotations (f, 3, 3). rotation_terms (f, t, 3): factors
    of the functions of the row about the camera's axes, `R(row) = R exp(rotation_terms(row)) exp(turn(row))`
    with the poses' own turns. drift (f, 3): along the camera's axes over an image height besides the
    velocities, over the depth, so that images do not depend on the block's scale."""
    frame, rows_px, heights_px, readouts_s = rows.frame, rows.rows_px, rows.heights_px, rows.readouts_s
    share, none = rows_px / heights_px - 0.5, np.zeros((len(frame), 3))
    axes, rates, terms, rotating = _of_frames(rotations, frame), none.T, None, none.T
    at_row = axes
    velocities = none if poses.velocities_m_per_s is None else poses.velocities_m_per_s[frame]
    if poses.turns is not None:
        turn, rate = poses.turns.at(share * readouts_s, frame)
        turn, rate = by_component(turn), by_component(rate)
        at_row = multiply_each(at_row, _turned(turn))
        rates = multiply_each(at_row, rate - 0.5 * cross_each(turn, rate))
    if rotation_terms is not None:
        recorded = recorded_share(poses.turns, frame, readouts_s)
        terms, slopes = terms_at(share, rotation_terms.shape[1], recorded, readouts_s < 0.0)
        by_term = np.swapaxes(_of_frames(rotation_terms @ np.swapaxes(rotations, 1, 2), frame), 0, 1)
        more = _turned(multiply_each(by_term, terms.T))
        rotating = multiply_each(by_term, slopes.T)
        at_row, rates = multiply_each(more, at_row), multiply_each(more, rates)
    drifting = none if drift is None else np.einsum("fij,fj->fi", rotations, drift)[frame]
    turned = _by_number(at_row)
    return Readout(
        *(rows_px, heights_px, turned, velocities, _by_number(rates)),
        *(terms, _by_number(axes), _by_number(rotating), drifting),
    )


def _turned(turn_rad: Floats) -> Floats:
    """Rotation matrices (3, 3, m) of rotation vectors (3, m), as `exp_turn` gives them."""
    angle = np.sqrt((turn_rad**2).sum(axis=0))
    x, y, z = turn_rad / np.maximum(angle, 1e-12)
    sine, versine = np.sin(angle), 1.0 - np.cos(angle)
    out = np.empty((3, 3, len(angle)))
    out[0, 0], out[1, 1], out[2, 2] = (
        1.0 - versine * (a * a + b * b) for a, b in ((y, z), (x, z), (x, y))
    )  # fmt: skip
    for i, j, a, b, c in ((0, 1, x, y, z), (2, 0, z, x, y), (1, 2, y, z, x)):
        even, odd = versine * (a * b), sine * c
        out[i, j], out[j, i] = even - odd, even + odd
    return out


def image_from_ground(of: Projections) -> Floats:
    """Image coordinates (m, 2) as `project` gives them, without derivatives."""
    turned, numbers, read = by_component(of.rotations), by_component(of.interior), of.read
    directions = _directions(of, turned, numbers)
    bent, slopes = _bends(directions, numbers, of.kinds, slopes=read is not None)
    image = bent * numbers[0] + numbers[1:3]
    if read is not None:
        image = read.seen_px(image, _by_row(read, turned, numbers, directions, slopes))
    return _by_number(image)


def project(of: Projections) -> tuple[Floats, Floats, Floats, Floats]:
    """Image coordinates (m, 2) and their derivatives by_pose (m, 2, d: position, turn in rad, rotation terms
    and drift), by_interior (m, 2, 9) and by_point (m, 2, 3). All are NaN behind the camera. A rotation's
    update is a small turn about the work frame's axes from the left, R = exp([t]) R0; see `Camera` and
    `Rotation`."""
    image, levers, by_interior, by_point = project_by_levers(of)
    return (
        _by_number(image), _by_number(levers.by_pose(by_point)), _by_number(by_interior), _by_number(by_point)
    )  # fmt: skip


def project_by_levers(of: Projections) -> tuple[Floats, Levers, Floats, Floats]:
    """As `project`, one column an observation, with `Levers` instead of derivatives by poses."""
    turned, numbers, read = by_component(of.rotations), by_component(of.interior), of.read
    directions = _directions(of, turned, numbers)
    d, u, v, z = directions
    f, terms = numbers[0], None if read is None else read.terms
    levers = rigid = Levers.rigid(d)
    if read is not None and terms is not None:
        levers = Levers(d, by_component(terms), (-read.shares * z)[None], by_component(read.axes))
    bent, slopes = _bends(directions, numbers, of.kinds, slopes=True)
    image = bent * f + numbers[1:3]
    by_interior = np.zeros((2, len(INTERIOR), len(u)))
    for lens, which in _lenses(of.kinds):
        x, y = u[which], v[which]
        for column, both in enumerate(lens.by_terms(x, y, x * x + y * y), 3):
            for axis in range(2):
                by_interior[axis, column, which] = f[which] * both[axis]
    by_u, by_v, scale = slopes[:2], slopes[1:], f / z
    by_camera = np.stack([-by_u, by_v, -(by_u * u + by_v * v)], axis=1) * scale
    by_point = multiply_each(by_camera, np.swapaxes(turned, 0, 1))
    if read is not None:
        along_drift = (by_point * read.drift.T).sum(axis=1) * read.shares
        by_point += along_drift[:, None] * turned[:, 2]
    by_interior[:, 0] = bent
    by_interior[0, 1] = by_interior[1, 2] = 1.0
    if read is not None:
        shown = np.concatenate([read.velocities_m_per_s, read.rates_rad_per_s], axis=1).T * read.shares
        by_interior[:, 8] = multiply_each(by_point, rigid.as_points_m(shown))
        by_row = _by_row(read, turned, numbers, directions, slopes)
        for derivatives in (by_interior, by_point):
            _in_own_row(derivatives, by_row)
        image = read.seen_px(image, by_row)
    return image, levers, by_interior, by_point


class _Directions(NamedTuple):
    """d (3, m): point minus projection centre. u, v (m,): its offsets to the right and down in the image over
    its distance along the view, without distortion. z (m,): its coordinate along the camera's own z, NaN
    behind the camera."""

    d: Floats
    u: Floats
    v: Floats
    z: Floats


def _directions(of: Projections, rotations: Floats, interior: Floats) -> _Directions:
    """Of points; rotations (3, 3, m), interior (9, m)."""
    d, read = by_component(of.points_m - of.positions_m), of.read
    if read is not None:
        d -= read.velocities_m_per_s.T * (interior[8] * read.shares)
    seen = d if read is None else d + read.drift.T * (read.shares * (rotations[:, 2] * d).sum(axis=0))
    x, y, z = multiply_each(np.swapaxes(rotations, 0, 1), seen)
    z = np.where(z < 0.0, z, np.nan)
    return _Directions(d, -x / z, y / z, z)


def _bends(
    directions: _Directions, interior: Floats, kinds: Ints | None, *, slopes: bool
) -> tuple[Floats, Floats]:
    """Directions as the lenses bend them (2, m), and the slopes of that (3, m) if asked for."""
    _, u, v, _ = directions
    bent, slope = np.empty((2, len(u))), np.empty((3, len(u) if slopes else 0))
    for lens, which in _lenses(kinds):
        x, y = u[which], v[which]
        r_sq, bends = x * x + y * y, interior[3:8, which]
        bent[:, which] = lens.bent(bends, x, y, r_sq)
        if slopes:
            slope[:, which] = lens.slopes(bends, x, y, r_sq)
    return bent, slope


def _by_row(
    read: Readout, rotations: Floats, interior: Floats, directions: _Directions, slopes: Floats
) -> Floats:
    """By how much points' images move while one row after the other is read, (2, m) px a row."""
    d, u, v, z = directions
    readout_s = interior[8]
    turning = readout_s * read.rates_rad_per_s.T + read.term_rotation_rad.T
    moving = read.drift.T * z - readout_s * read.velocities_m_per_s.T
    moving -= cross_each(turning, d)
    x, y, along = multiply_each(np.swapaxes(rotations, 0, 1), moving)
    du, dv = -(x + u * along) / z, (y - v * along) / z
    moved = np.stack([slopes[0] * du + slopes[1] * dv, slopes[1] * du + slopes[2] * dv])
    moved *= interior[0] / read.heights_px
    return np.asarray(np.clip(moved, -_MOST_BY_ROW, _MOST_BY_ROW))


def _in_own_row(derivatives: Floats, by_row: Floats) -> None:
    """Derivatives (2, k, m) by which the row itself moves, in place."""
    derivatives[1] /= 1.0 - by_row[1]
    derivatives[0] += by_row[0] * derivatives[1]


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
