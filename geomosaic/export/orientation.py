"""The exterior orientation of every frame in the terms surveyors use: what positions.csv and layers hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import Rotation, about_x, about_y, about_z
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.model import Survey

Floats = NDArray[np.float64]
_SMALL_SHARE = 0.1


@dataclass(frozen=True)
class Orientations:
    """Arrays with one entry for each of n frames; NaN where nothing is known.

    lon_lat_height (n, 3): degrees and ellipsoidal metres of the projection centre. map_m (n, 2): easting
    and northing. yaw_pitch_roll_deg (n, 3): yaw the heading of the image's top from true north at the frame,
    pitch -90 at the nadir, roll the body's. omega_phi_kappa_deg (n, 3): relative to the map grid's east and
    north at the frame, in the order of `Rotation.from_omega_phi_kappa`. sd_m (n, 3): easting, northing, up.
    sd_omega_phi_kappa_deg (n, 3). moved_m (n,): distance in space from the prior position. turned_deg (n,):
    angle between prior and adjusted rotation.
    """

    names: tuple[str, ...]
    status: tuple[str, ...]
    lon_lat_height: Floats
    map_m: Floats
    yaw_pitch_roll_deg: Floats
    omega_phi_kappa_deg: Floats
    sd_m: Floats
    sd_omega_phi_kappa_deg: Floats
    moved_m: Floats
    turned_deg: Floats


def orientations(survey: Survey, prior: Poses, adjusted: Adjusted) -> Orientations:
    """Brings adjusted poses from the work frame to each frame's own axes, and those of the map grid."""
    poses = adjusted.poses
    projection = MapProjection(survey.map_crs)
    geodetic = survey.work_frame.geodetic_from_enu(poses.positions_m)
    lon, lat = geodetic[:, 0], geodetic[:, 1]
    local_from_work = np.swapaxes(survey.work_frame.enu_from_local_rotation(lon, lat), -1, -2)
    grid_from_work = about_z(projection.grid_convergence_rad(lon, lat)) @ local_from_work
    yaw, pitch, roll = Rotation(local_from_work @ poses.rotations).yaw_pitch_roll()
    omega, phi, kappa = Rotation(grid_from_work @ poses.rotations).omega_phi_kappa()
    turn = np.swapaxes(prior.rotations, -1, -2) @ poses.rotations
    cosine = (np.trace(turn, axis1=-2, axis2=-1) - 1.0) / 2.0
    return Orientations(
        names=tuple(frame.name for frame in survey.frames),
        status=adjusted.status,
        lon_lat_height=geodetic,
        map_m=projection.map_from_geodetic(lon, lat),
        yaw_pitch_roll_deg=np.degrees(np.stack([yaw % (2.0 * np.pi), pitch - np.pi / 2.0, roll], axis=-1)),
        omega_phi_kappa_deg=np.degrees(np.stack([omega, phi, kappa], axis=-1)),
        sd_m=_turned_sd(grid_from_work, poses.positions_sd_m),
        sd_omega_phi_kappa_deg=np.degrees(
            _turned_sd(_angles_from_axes(omega, phi) @ grid_from_work, poses.rotations_sd_rad)
        ),
        moved_m=np.linalg.norm(poses.positions_m - prior.positions_m, axis=-1),
        turned_deg=np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))),
    )


def _angles_from_axes(omega_rad: Floats, phi_rad: Floats) -> Floats:
    """d(omega, phi, kappa) per small turn about east, north and up, (n, 3, 3).

    A turn is d_omega about east, d_phi about the turned north, d_kappa about the image's normal:
    `[e1, Rx e2, Rx Ry e3] d`; this is its inverse.
    """
    rx, ry = about_x(omega_rad), about_y(phi_rad)
    east = np.zeros((*rx.shape[:-2], 3))
    east[..., 0] = 1.0
    return np.linalg.pinv(np.stack([east, rx[..., :, 1], (rx @ ry)[..., :, 2]], axis=-1))


def _turned_sd(matrix: Floats, sd: Floats) -> Floats:
    """Standard deviations (n, 3) of `matrix @ x` for independent x.

    Unknown (NaN) where a component of x is that has a share above 0.1.
    """
    known = np.where(np.isfinite(sd), sd, 0.0)
    out = np.sqrt(np.einsum("nij,nj->ni", matrix**2, known**2))
    lost = (np.abs(matrix) > _SMALL_SHARE) & ~np.isfinite(sd)[:, None, :]
    return np.where(lost.any(axis=-1), np.nan, out)
