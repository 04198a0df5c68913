"""From the work frame to the survey's map: places and axes."""

from __future__ import annotations

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.rotation import about_z
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.model import Survey


def map_from_work(survey: Survey, enu_m: Floats) -> Floats:
    """Easting and northing (..., 2) of points (..., 3) in the work frame."""
    geodetic = survey.work_frame.geodetic_from_enu(enu_m)
    return MapProjection(survey.map_crs).map_from_geodetic(geodetic[..., 0], geodetic[..., 1])


def work_from_map(survey: Survey, map_m: Floats) -> Floats:
    """East and north (..., 2) in the work frame of eastings and northings (..., 2), at its own height."""
    geodetic = MapProjection(survey.map_crs).geodetic_from_map(map_m[..., 0], map_m[..., 1])
    height_m = survey.work_frame.height_ellipsoidal_m
    return survey.work_frame.enu_from_geodetic(geodetic[..., 0], geodetic[..., 1], height_m)[..., :2]


def local_from_work(survey: Survey, enu_m: Floats) -> Floats:
    """Rotations (n, 3, 3) to the true east, north and up at points (n, 3) from the work frame's axes."""
    geodetic = survey.work_frame.geodetic_from_enu(enu_m)
    turn = survey.work_frame.enu_from_local_rotation(geodetic[:, 0], geodetic[:, 1])
    return np.asarray(np.swapaxes(turn, -1, -2))


def grid_from_work(survey: Survey, enu_m: Floats) -> Floats:
    """Rotations (n, 3, 3) to the map grid's east and north, and up, at points (n, 3).

    True north lies the grid's convergence west of grid north, so that local axes turn by it to the left.
    """
    if not len(enu_m):
        return np.zeros((0, 3, 3))
    geodetic = survey.work_frame.geodetic_from_enu(enu_m)
    convergence = MapProjection(survey.map_crs).grid_convergence_rad(geodetic[:, 0], geodetic[:, 1])
    return np.asarray(about_z(convergence) @ local_from_work(survey, enu_m))
