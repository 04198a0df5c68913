"""Longitude and latitude of a frame by EXIF and by XMP: the finer of both, with the signs that are stated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m
from geomosaic.survey.exif import Exif
from geomosaic.survey.xmp import Xmp, number

_STEPS = tuned((60.0, 1.0, 0.1, 0.01, 0.001), "seconds of arc", "that programs round to, whole minutes first")
_WHOLE = tuned(1e-4, "steps", "off a whole one; less: rounding hides a cut; more: chance looks cut")
_APART_M = tuned(30.0, "m", "between both sources; less: fixes taken at other moments; more: wrong ones pass")
FINER, SIGNED, APART = "finer", "signed", "apart"


@dataclass(frozen=True)
class TaggedPlace:
    """Longitude and latitude in degrees. by: why XMP's value or signs were taken (`FINER` than whole seconds
    or minutes, `SIGNED`), that both sources contradict each other and EXIF's was taken (`APART`), or nothing.
    hemisphere_assumed: no source says N or S, E or W."""

    lon_deg: float
    lat_deg: float
    by: str = ""
    hemisphere_assumed: bool = False


def tagged_place(exif: Exif, xmp: Xmp) -> TaggedPlace | None:
    """Where the tags say the frame was taken; None where neither source has a position.

    Programs that edit images round EXIF's position to minutes, seconds or decimals of seconds of arc, or lose
    its references (N, S, E, W); DJI's XMP holds signed decimal degrees. XMP's is taken where it lies off the
    coarsest grid that EXIF's lies on, by no more than a step.
    """
    other = _xmp_place(xmp)
    if exif.lon_deg is None or exif.lat_deg is None:
        return None if other is None else _place(other)
    own = np.array([exif.lon_deg, exif.lat_deg])
    alone = _place(own, "", exif.hemisphere_assumed)
    if other is None:
        return alone
    step = next((s for s in _STEPS if _rounded(own, s) and not _rounded(other, s)), 0.0)
    differ = 3600.0 * float(np.abs(np.abs(own) - np.abs(other)).max())
    if differ > max(step, 1.0):
        apart_m = float(np.linalg.norm(mid_latitude_offset_m(*own, *other)))
        return _place(own, APART if apart_m > _APART_M else "", exif.hemisphere_assumed)
    signed = np.copysign(own, other)
    by = SIGNED if not np.array_equal(signed, own) else FINER if step >= 1.0 else ""
    return _place(other if differ <= step else signed, by)


def _place(lonlat: Floats, by: str = "", hemisphere_assumed: bool = False) -> TaggedPlace:
    return TaggedPlace(float(lonlat[0]), float(lonlat[1]), by, hemisphere_assumed)


def _xmp_place(xmp: Xmp) -> Floats | None:
    lon = number(xmp, "drone-dji:GpsLongitude", "drone-dji:GpsLongtitude", "drone-dji:Longitude")
    lat = number(xmp, "drone-dji:GpsLatitude", "drone-dji:Latitude")
    if lon is None or lat is None or (lon == 0.0 and lat == 0.0) or abs(lat) > 90.0 or abs(lon) > 180.0:
        return None
    return np.array([lon, lat])


def _rounded(degrees: Floats, step: float) -> bool:
    """Whether all are whole steps, which are in seconds of arc."""
    steps = 3600.0 / step * degrees
    return bool((np.abs(steps - np.round(steps)) < _WHOLE).all())
