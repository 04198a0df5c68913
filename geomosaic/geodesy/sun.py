"""Where the sun stands."""

from __future__ import annotations

import math

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import DAY_S, sourced

_J2000_S = sourced(946_728_000.0, "s", "since 1970, of 2000-01-01 12:00 UTC", "definition of J2000.0")
_LOW_PRECISION = "Astronomical Almanac, section C, low-precision formulas of the sun, to 0.01 deg"
_CENTRE = sourced((1.915, 0.020), "deg", "equation of the centre", _LOW_PRECISION)
_LINEAR = sourced(
    ((280.460, 0.9856474), (357.528, 0.9856003), (23.439, -0.0000004), (280.46062, 360.9856474)),
    "deg, deg/day",
    "the sun's mean longitude and mean anomaly, obliquity of the ecliptic, Greenwich mean sidereal time",
    _LOW_PRECISION,
)


def sun_direction(lon_deg: float, lat_deg: float, time_s: float) -> Floats:
    """The unit vector (east, north, up) towards the sun's centre, without refraction.

    Args: time_s: UTC since 1970.
    """
    days = (time_s - _J2000_S) / DAY_S
    longitude, anomaly, obliquity, sidereal = (math.radians(start + rate * days) for start, rate in _LINEAR)
    longitude += math.radians(_CENTRE[0]) * math.sin(anomaly)
    longitude += math.radians(_CENTRE[1]) * math.sin(2.0 * anomaly)
    ascension = math.atan2(math.cos(obliquity) * math.sin(longitude), math.cos(longitude))
    declination = math.asin(math.sin(obliquity) * math.sin(longitude))
    hour, lat = sidereal + math.radians(lon_deg) - ascension, math.radians(lat_deg)
    return np.array(
        [
            -math.cos(declination) * math.sin(hour),
            math.sin(declination) * math.cos(lat) - math.cos(declination) * math.sin(lat) * math.cos(hour),
            math.sin(declination) * math.sin(lat) + math.cos(declination) * math.cos(lat) * math.cos(hour),
        ]
    )
