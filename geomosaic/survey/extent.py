"""How far the positions of a survey reach."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.errors import InputError
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.model import Position

TOO_FAR_M = tuned(300_000.0, "m", "from the survey's centre: less refuses long corridors; more keeps others'")


def lonlat_of(positions: Sequence[Position]) -> Floats:
    """Longitudes and latitudes (n, 2), longitudes without a jump at 180 degrees."""
    lonlat = np.array([[p.lon_deg, p.lat_deg] for p in positions])
    lonlat[:, 0] = lonlat[0, 0] + (lonlat[:, 0] - lonlat[0, 0] + 180.0) % 360.0 - 180.0
    return lonlat


def distances_m(a: Floats, b: Floats) -> Floats:
    """Between two rows of places, longitude and latitude (n, 2) each: (n,)."""
    return np.asarray(np.linalg.norm(mid_latitude_offset_m(*a.T, *b.T), axis=1))


def check_extent(headers: Sequence[FrameHeader], positions: Sequence[Position]) -> None:
    """No survey reaches so far: `InputError` naming the frame that lies farthest out."""
    away = away_m(positions)
    i = int(np.argmax(away))
    if away[i] > TOO_FAR_M:
        raise InputError(
            f"lies {away[i] / 1000.0:.0f} km from the middle of the survey",
            file=headers[i].path,
            fix="correct its position, or take the frame out of the folder",
        )


def away_m(positions: Sequence[Position]) -> Floats:
    """Distances (n,) from the middle of the known positions; 0 for those that aren't."""
    lonlat, known = lonlat_of(positions), np.array([p.known for p in positions])
    if not known.any():
        return np.zeros(len(lonlat))
    middle = np.broadcast_to(np.median(lonlat[known], axis=0), lonlat.shape)
    return np.where(known, distances_m(lonlat, middle), 0.0)
