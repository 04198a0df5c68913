"""How far all heights of a block may be off in common, which no number of frames averages out."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.constants import CHOSEN, NORMAL_PER_MAD, Because
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.survey.accuracy import POSITION
from geomosaic.survey.model import Survey

_DRIFT_CLEARLY: Annotated[
    float,
    Because(
        "deviations",
        "of the scatter about it, beyond which heights drift: one flight in 400 by chance",
        "normal distribution: 0.3 %",
    ),
] = 3.0
_SEA_LEVEL_SD_M: Annotated[
    float,
    Because(
        "m",
        "of sea level about the ellipsoid: most receivers write heights above it, and none says so",
        "EGM96: root mean square of the geoid's heights 30.6 m, from -107 to 85 m",
    ),
] = 30.0
_TAKE_OFF: Annotated[
    float,
    Because(
        "flying heights",
        "within which the ground comes out about height 0 where heights count from the take-off: it lies on "
        "the same slope, not a whole flying height away; by the sea both are the same",
        CHOSEN,
    ),
] = 0.5
_LAND_M: Annotated[
    float,
    Because(
        "m",
        "of the land above the sea, which is what heights that count from the take-off leave out",
        "ETOPO1's hypsographic curve: land lies 797 m high in the mean",
    ),
] = 800.0


def common_height_sd_m(survey: Survey, adjusted: Adjusted) -> float:
    """The deviation of the block's height as a whole, besides what its covariance says; 0 where control
    points or a DEM hold it, or where all is in a local frame; that of nothing observed where no height is
    given.

    Altitudes in EXIF have no stated datum: all frames share their deviation, and that of what they count
    from: the ellipsoid, the sea or, where the ground comes out about height 0, the take-off. And heights that
    drift say no better where the block lies than they differ from it.
    """
    held = any(not c.check and not c.plan_only and c.images for c in survey.control)
    heights = np.array([f.position.height_ellipsoidal_m for f in survey.frames], dtype=np.float64)
    known = np.isfinite(heights) & (np.array(adjusted.status) == "tied")
    if held or survey.elevation is not None or is_local(survey.map_crs):
        return 0.0
    if not known.any():
        return POSITION["none"].sd_vertical_m
    stated = np.array([f.position.sd_vertical_m for f in survey.frames])[known]
    unknown_datum = np.array([f.position.source == "exif" for f in survey.frames])[known]
    at_m = adjusted.poses.positions_m[known]
    found = survey.work_frame.geodetic_from_enu(at_m)[:, 2]
    datum_m = 0.0
    if unknown_datum.mean() > 0.5:
        above_m = float(np.median(at_m[:, 2] - adjusted.ground.up_at(at_m[:, 0], at_m[:, 1])))
        take_off = abs(float(np.median(found)) - above_m) < _TAKE_OFF * above_m
        datum_m = float(np.hypot(np.median(stated), _LAND_M if take_off else _SEA_LEVEL_SD_M))
    off = heights[known] - found
    spread_m = NORMAL_PER_MAD * float(np.median(np.abs(off - np.median(off))))
    drift_m = spread_m if spread_m > _DRIFT_CLEARLY * float(np.median(stated)) or datum_m else 0.0
    return float(np.hypot(datum_m, drift_m))


def with_common_height(adjusted: Adjusted, sd_m: float) -> Adjusted:
    """The outcome with a deviation that the heights of all tied frames share."""
    tied = np.array(adjusted.status) == "tied"
    sd = adjusted.poses.positions_sd_m.copy()
    sd[tied, 2] = np.hypot(sd[tied, 2], sd_m)
    poses = replace(adjusted.poses, positions_sd_m=sd)
    covariance = adjusted.pose_covariance
    if covariance is not None:
        covariance = covariance.copy()
        covariance[tied, 2, 2] += sd_m**2
    return replace(adjusted, poses=poses, pose_covariance=covariance)
