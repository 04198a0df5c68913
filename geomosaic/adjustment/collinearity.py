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
    d = points_m - positions_m
    if passing_m_per_s is not None:
        d = d - interior[:, 8:] * passing_m_per_s
    x, y, z = np.einsum("mij,mi->jm", rotations, d)
    z = np.where(z < 0.0, z, np.nan)
    u, v = -x / z, y / z
    f, _, _, k1, k2, k3, p1, p2 = interior[:, :8].T
    r2 = u * u + v * v
    s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    ds = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
    xd = u * s + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u)
    yd = v * s + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v
    image = np.stack([interior[:, 1] + f * xd, interior[:, 2] + f * yd], axis=-1)
    mixed = 2.0 * u * v * ds + 2.0 * p1 * u + 2.0 * p2 * v
    by_uv = np.empty((len(u), 2, 2))
    by_uv[:, 0, 0] = s + 2.0 * u * u * ds + 2.0 * p1 * v + 6.0 * p2 * u
    by_uv[:, 0, 1] = by_uv[:, 1, 0] = mixed
    by_uv[:, 1, 1] = s + 2.0 * v * v * ds + 6.0 * p1 * v + 2.0 * p2 * u
    uv_by_camera = np.zeros((len(u), 2, 3))
    uv_by_camera[:, 0, 0] = -1.0 / z
    uv_by_camera[:, 0, 2] = x / z**2
    uv_by_camera[:, 1, 1] = 1.0 / z
    uv_by_camera[:, 1, 2] = -y / z**2
    by_point = (f[:, None, None] * by_uv) @ uv_by_camera @ np.swapaxes(rotations, 1, 2)
    by_turn = np.cross(by_point, d[:, None, :])
    by_pose = np.concatenate([-by_point, by_turn], axis=2)
    by_interior = np.zeros((len(u), 2, len(INTERIOR)))
    by_interior[:, 0, 0], by_interior[:, 1, 0] = xd, yd
    by_interior[:, 0, 1] = by_interior[:, 1, 2] = 1.0
    for column, power in ((3, r2), (4, r2**2), (5, r2**3)):
        by_interior[:, 0, column], by_interior[:, 1, column] = f * u * power, f * v * power
    by_interior[:, 0, 6], by_interior[:, 1, 6] = f * 2.0 * u * v, f * (r2 + 2.0 * v * v)
    by_interior[:, 0, 7], by_interior[:, 1, 7] = f * (r2 + 2.0 * u * u), f * 2.0 * u * v
    if passing_m_per_s is not None:
        by_interior[:, :, 8] = -np.einsum("maj,mj->ma", by_point, passing_m_per_s)
    return image, by_pose, by_interior, by_point


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
