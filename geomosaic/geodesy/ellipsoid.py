"""WGS 84: radii of curvature and the paper's mid-latitude formula."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Floats
from geomosaic.constants import sourced

_WGS84: Final = "NGA.STND.0036_1.0.0_WGS84 (2014), table 3.1"
SEMI_MAJOR_M = sourced(6378137.0, "m", "equatorial radius; defines WGS 84", _WGS84)
FLATTENING: float = sourced(1.0 / 298.257223563, "1", "of the ellipsoid; defines WGS 84", _WGS84)
SEMI_MINOR_M: Final = SEMI_MAJOR_M * (1.0 - FLATTENING)
MEAN_RADIUS_M: Final = float(np.mean([SEMI_MAJOR_M, SEMI_MAJOR_M, SEMI_MINOR_M]))
ECCENTRICITY_SQ: Final = FLATTENING * (2.0 - FLATTENING)
SECOND_ECCENTRICITY_SQ: Final = ECCENTRICITY_SQ / (1.0 - ECCENTRICITY_SQ)


def longitudes_near(lon_deg: Floats, about_deg: float) -> Floats:
    """Longitudes within half a turn of one, so that they do not jump at 180 degrees."""
    return np.asarray(lon_deg - 360.0 * np.rint((lon_deg - about_deg) / 360.0))


def middle_of(lonlat: Floats) -> tuple[float, float]:
    """Median longitude and latitude of places (n, 2), also where these lie on both sides of 180 degrees."""
    lon = float(np.median(longitudes_near(lonlat[:, 0], lonlat[0, 0])))
    return (lon + 180.0) % 360.0 - 180.0, float(np.median(lonlat[:, 1]))


def meridian_radius_m(lat_rad: ArrayLike) -> Floats:
    """Radius of curvature in the meridian, M = a (1 - e²) / (1 - e² sin² B)^(3/2)."""
    w_sq = 1.0 - ECCENTRICITY_SQ * np.sin(np.asarray(lat_rad, dtype=np.float64)) ** 2
    return np.asarray(SEMI_MAJOR_M * (1.0 - ECCENTRICITY_SQ) / w_sq**1.5)


def prime_vertical_radius_m(lat_rad: ArrayLike) -> Floats:
    """Radius of curvature in the prime vertical, N = a / sqrt(1 - e² sin² B)."""
    w_sq = 1.0 - ECCENTRICITY_SQ * np.sin(np.asarray(lat_rad, dtype=np.float64)) ** 2
    return np.asarray(SEMI_MAJOR_M / np.sqrt(w_sq))


def mid_latitude_offset_m(
    lon_from_deg: ArrayLike, lat_from_deg: ArrayLike, lon_to_deg: ArrayLike, lat_to_deg: ArrayLike
) -> Floats:
    """East and north offset between two points by the mid-latitude formula.

    The nadir points on the map of Yue et al. 2021 (IRLA20200529), equation 4: radii at the mean
    latitude B0, with the second eccentricity's term in the meridian. The paper counts y to the west
    (delta L = L1 - L2); here the first component is to the east. Up to 60 degrees of latitude lengths are off
    by at most 4 um at 1 km, 4 mm at 10 km, 4 m at 100 km. Directions are those at the middle point, half the
    meridians' convergence away from those at the start (see docs/methods/paper_methods.md).

    Args: degrees, any shapes that broadcast. Longitudes may lie on both sides of 180 degrees.
    Returns: (..., 2) metres, east and north.
    """
    lat_1 = np.radians(np.asarray(lat_from_deg, dtype=np.float64))
    lat_2 = np.radians(np.asarray(lat_to_deg, dtype=np.float64))
    d_lon = np.asarray(lon_to_deg, dtype=np.float64) - np.asarray(lon_from_deg, dtype=np.float64)
    d_lon = np.radians((d_lon + 180.0) % 360.0 - 180.0)
    d_lat = lat_2 - lat_1
    lat_0 = (lat_1 + lat_2) / 2.0
    bend = 1.0 + SECOND_ECCENTRICITY_SQ * d_lat**2 * np.cos(2.0 * lat_0) / 8.0
    north = meridian_radius_m(lat_0) * d_lat * bend
    east = prime_vertical_radius_m(lat_0) * np.cos(lat_0) * d_lon
    return np.stack(np.broadcast_arrays(east, north), axis=-1)
