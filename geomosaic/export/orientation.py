"""The exterior orientation of every frame in the terms surveyors use: what positions.csv and layers hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Bools, Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import Rotation, about_x, about_y
from geomosaic.constants import SLIGHT
from geomosaic.export.on_map import grid_from_work, local_from_work, map_from_work
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.placement.prior import heading_assumed, position_assumed
from geomosaic.survey.model import Survey

_SMALL_SHARE = 0.1


@dataclass(frozen=True)
class Orientations:
    """Arrays with one entry for each of n frames; NaN where nothing is known.

    lon_lat_height (n, 3): degrees and ellipsoidal metres of the projection centre. map_m (n, 2): easting
    and northing. yaw_pitch_roll_deg (n, 3): yaw the heading of the image's top from true north at the frame,
    pitch -90 at the nadir, roll the body's. omega_phi_kappa_deg (n, 3): relative to the map grid's east and
    north at the frame, in the order of `Rotation.from_omega_phi_kappa`. covariance_m2 (n, 3, 3): of easting,
    northing, up; sd_m (n, 3): the same as deviations. sd_omega_phi_kappa_deg (n, 3). Frames that no
    adjustment moved keep the deviations of their POS; those in plan are unknown where nobody reported the
    position. Rejected frames without a reported position have no place. moved_m (n,): distance in space from
    the prior position. turned_deg (n,): angle between prior and adjusted rotation.
    """

    names: tuple[str, ...]
    status: tuple[str, ...]
    lon_lat_height: Floats
    map_m: Floats
    yaw_pitch_roll_deg: Floats
    omega_phi_kappa_deg: Floats
    covariance_m2: Floats
    sd_m: Floats
    sd_omega_phi_kappa_deg: Floats
    moved_m: Floats
    turned_deg: Floats

    @property
    def placed(self) -> Bools:
        """Which frames (n,) have a place."""
        return np.asarray(np.isfinite(self.map_m).all(axis=1))


def orientations(survey: Survey, prior: Poses, adjusted: Adjusted) -> Orientations:
    """Brings adjusted poses from the work frame to each frame's own axes, and those of the map grid."""
    poses = adjusted.poses
    local, grid = local_from_work(survey, poses.positions_m), grid_from_work(survey, poses.positions_m)
    yaw, pitch, roll = Rotation(local @ poses.rotations).yaw_pitch_roll()
    omega, phi, kappa = Rotation(grid @ poses.rotations).omega_phi_kappa()
    turn = np.swapaxes(prior.rotations, -1, -2) @ poses.rotations
    cosine = (np.trace(turn, axis1=-2, axis2=-1) - 1.0) / 2.0
    moved_m = np.linalg.norm(poses.positions_m - prior.positions_m, axis=-1)
    turned = np.arccos(np.clip(cosine, -1.0, 1.0))
    still = (moved_m < SLIGHT) & (np.abs(turn - np.eye(3)).max(axis=(-1, -2)) < SLIGHT)
    place, axes = _covariances(adjusted, prior, still)
    place[still & position_assumed(prior), :2] = np.nan
    nowhere = position_assumed(prior) & (np.array(adjusted.status) == "rejected")
    place[nowhere] = np.nan
    at_m = np.where(nowhere[:, None], np.nan, poses.positions_m)
    covariance_m2 = _turned_covariance(grid, place)
    angles = _turned_covariance(_angles_from_axes(omega, phi) @ grid, axes)
    return Orientations(
        names=tuple(frame.name for frame in survey.frames),
        status=adjusted.status,
        lon_lat_height=_lon_lat_height(survey, at_m),
        map_m=map_from_work(survey, at_m),
        yaw_pitch_roll_deg=np.degrees(np.stack([yaw % (2.0 * np.pi), pitch - np.pi / 2.0, roll], axis=-1)),
        omega_phi_kappa_deg=np.degrees(np.stack([omega, phi, kappa], axis=-1)),
        covariance_m2=covariance_m2,
        sd_m=_deviations(covariance_m2),
        sd_omega_phi_kappa_deg=np.degrees(_deviations(angles)),
        moved_m=np.where(position_assumed(prior), np.nan, moved_m),
        turned_deg=np.where(heading_assumed(prior), np.nan, np.degrees(turned)),
    )


def _lon_lat_height(survey: Survey, positions_m: Floats) -> Floats:
    """Geodetic; longitude and latitude unknown of a local frame."""
    out = survey.work_frame.geodetic_from_enu(positions_m)
    if is_local(survey.map_crs):
        out[:, :2] = np.nan
    return out


def _covariances(adjusted: Adjusted, prior: Poses, still: Bools) -> tuple[Floats, Floats]:
    """Of the positions and of the turns about the work frame's axes, (n, 3, 3) each.

    A method's own where it has them; else from deviations, as if independent: those of the prior for
    frames that stand where it put them.
    """
    poses, solved = adjusted.poses, adjusted.pose_covariance
    out = []
    for k, mine, before in (
        (slice(0, 3), poses.positions_sd_m, prior.positions_sd_m),
        (slice(3, 6), poses.rotations_sd_rad, prior.rotations_sd_rad),
    ):
        sd = np.where(still[:, None], before, mine)
        covariance = np.zeros((len(sd), 3, 3))
        covariance[:, [0, 1, 2], [0, 1, 2]] = sd**2
        if solved is not None:
            own = ~still & np.isfinite(solved).all(axis=(1, 2))
            covariance[own] = solved[own, k, k]
        out.append(covariance)
    return out[0], out[1]


def _angles_from_axes(omega_rad: Floats, phi_rad: Floats) -> Floats:
    """d(omega, phi, kappa) per small turn about east, north and up, (n, 3, 3).

    A turn is d_omega about east, d_phi about the turned north, d_kappa about the image's normal:
    `[e1, Rx e2, Rx Ry e3] d`; this is its inverse.
    """
    rx, ry = about_x(omega_rad), about_y(phi_rad)
    east = np.zeros((*rx.shape[:-2], 3))
    east[..., 0] = 1.0
    return np.linalg.pinv(np.stack([east, rx[..., :, 1], (rx @ ry)[..., :, 2]], axis=-1))


def _turned_covariance(matrix: Floats, covariance: Floats) -> Floats:
    """Covariances (n, 3, 3) of `matrix @ x`.

    Unknown (NaN) where a component of x is that has a share above 0.1.
    """
    known = np.isfinite(np.diagonal(covariance, axis1=-2, axis2=-1))
    both = known[:, :, None] & known[:, None, :]
    out = matrix @ np.where(both, covariance, 0.0) @ np.swapaxes(matrix, -1, -2)
    lost = np.asarray(((np.abs(matrix) > _SMALL_SHARE) & ~known[:, None, :]).any(axis=-1))
    return np.where(lost[:, :, None] | lost[:, None, :], np.nan, out)


def _deviations(covariance: Floats) -> Floats:
    return np.asarray(np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)))
