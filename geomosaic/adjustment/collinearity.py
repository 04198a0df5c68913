"""The collinearity equations over many observations at once, with analytic derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation as Turn

from geomosaic.camera.interior import Camera

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

INTERIOR = (
    "focal_length_px",
    "principal_col_px",
    "principal_row_px",
    "k1",
    "k2",
    "k3",
    "p1",
    "p2",
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
) -> Floats:
    """Image coordinates (m, 2) as `project` gives them, without derivatives."""
    _, u, v, _ = _directions(positions_m, rotations, interior, points_m, passing_m_per_s)
    return np.stack(_distorted(interior, u, v)[:2], axis=-1) * interior[:, :1] + interior[:, 1:3]


def project(
    positions_m: Floats,
    rotations: Floats,
    interior: Floats,
    points_m: Floats,
    passing_m_per_s: Floats | None = None,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Image coordinates and their derivatives, one row an observation.

    See `Camera` and `Rotation` for the equations. A rotation's update is a small turn about the work
    frame's axes from the left, R = exp([t]) R0.

    Args: positions_m (m, 3), rotations (m, 3, 3), interior (m, 9) in the order of INTERIOR,
        points_m (m, 3). passing_m_per_s (m, 3): by what the projection centre moves for each second of
        readout until the observation's row is read, see `passing`.
    Returns: image_px (m, 2); by_pose (m, 2, 6): position, then turn in rad; by_interior (m, 2, 9);
        by_point (m, 2, 3). NaN behind the camera.
    """
    d, u, v, z = _directions(positions_m, rotations, interior, points_m, passing_m_per_s)
    xd, yd, r2, s = _distorted(interior, u, v)
    f, _, _, k1, k2, k3, p1, p2 = interior[:, :8].T
    image = np.stack([interior[:, 1] + f * xd, interior[:, 2] + f * yd], axis=-1)
    ds = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
    mixed = 2.0 * u * v * ds + 2.0 * p1 * u + 2.0 * p2 * v
    by_u = [s + 2.0 * u * u * ds + 2.0 * p1 * v + 6.0 * p2 * u, mixed]
    by_v = [mixed, s + 2.0 * v * v * ds + 6.0 * p1 * v + 2.0 * p2 * u]
    by_camera = np.empty((len(u), 2, 3))
    for axis in range(2):
        by_camera[:, axis, 0] = -by_u[axis]
        by_camera[:, axis, 1] = by_v[axis]
        by_camera[:, axis, 2] = -(by_u[axis] * u + by_v[axis] * v)
    by_camera *= (f / z)[:, None, None]
    by_point = by_camera @ np.swapaxes(rotations, 1, 2)
    by_pose = np.empty((len(u), 2, 6))
    np.negative(by_point, out=by_pose[:, :, :3])
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        by_pose[:, :, 3 + axis] = (
            by_point[:, :, one] * d[:, two, None] - by_point[:, :, two] * d[:, one, None]
        )
    by_interior = np.zeros((len(u), 2, len(INTERIOR)))
    by_interior[:, 0, 0], by_interior[:, 1, 0] = xd, yd
    by_interior[:, 0, 1] = by_interior[:, 1, 2] = 1.0
    fu, fv = f * u, f * v
    for column, power in ((3, r2), (4, r2 * r2), (5, r2 * r2 * r2)):
        by_interior[:, 0, column], by_interior[:, 1, column] = fu * power, fv * power
    by_interior[:, 0, 6] = by_interior[:, 1, 7] = 2.0 * fu * v
    by_interior[:, 1, 6] = f * (r2 + 2.0 * v * v)
    by_interior[:, 0, 7] = f * (r2 + 2.0 * u * u)
    if passing_m_per_s is not None:
        by_interior[:, :, 8] = -np.einsum("maj,mj->ma", by_point, passing_m_per_s)
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


def _distorted(interior: Floats, u: Floats, v: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """u and v after distortion, the squared radius, and the radial factor, (m,) each."""
    _, _, _, k1, k2, k3, p1, p2 = interior[:, :8].T
    r2 = u * u + v * v
    s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = u * s + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    yd = v * s + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v
    return xd, yd, r2, s


def passing(velocities_m_per_s: Floats | None, row_px: Floats, heights_px: Floats) -> Floats | None:
    """`project`'s passing_m_per_s from velocities (m, 3), the rows of observations (m,) as measured, and the
    heights of their pictures (m,)."""
    if velocities_m_per_s is None:
        return None
    return np.asarray(velocities_m_per_s * (row_px / heights_px - 0.5)[:, None])


def exp_turn(turn_rad: Floats) -> Floats:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3), Rodrigues' formula."""
    angle = np.linalg.norm(turn_rad, axis=1)
    safe = np.maximum(angle, 1e-12)
    axis = turn_rad / safe[:, None]
    k = np.zeros((len(turn_rad), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    k -= np.swapaxes(k, 1, 2)
    sin, cos = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sin * k + (1.0 - cos) * (k @ k))


def log_turn(rotations: Floats) -> Floats:
    """Rotation vectors (n, 3) of rotation matrices (n, 3, 3), lengths of 0 to pi. By way of quaternions,
    since the matrix's own skew part vanishes at half a turn."""
    return np.asarray(Turn.from_matrix(rotations).as_rotvec())
