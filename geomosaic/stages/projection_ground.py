"""The ground under the survey: a DEM if there is one, else flat."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.placement.heights import (
    FlyingHeight,
    frame_heights_m,
    ground_height_m,
    with_any_height,
    with_heights_above_ground,
)
from geomosaic.placement.reach import ground_pixel_m, half_extent_m
from geomosaic.projection.ground import GroundSurface, flat_ground
from geomosaic.projection.relief import relief
from geomosaic.survey.dem import dem_crs, dem_middle_x, outliers_warning, read_heights
from geomosaic.survey.model import Survey

_MOST_FLAT_REACH = 3.0
_MOST_OFF_M = tuned(250.0, "m", "a geoid is off by up to 107 m, barometers by weather; more misses feet")
_NODE_PX = 4.0  # ground pixels between the nodes of a surface: edges of walls are no sharper in a mosaic


class GroundParams(StageParams):
    """See each parameter's help."""

    height_m: float | Literal["auto"] = param(
        "auto",
        help="ellipsoidal height of flat ground; auto: from the frames' heights",
        unit="m",
        ge=-500,
        le=9000,
    )


@stage(
    "projection.ground", "Make the ground surface", group="Projection", version=11,
    outputs=("prior_ground", "levelled_survey"),
    formerly={"prior_ground": "ground", "levelled_survey": "survey"},
)  # fmt: skip
def projection_ground(
    survey: Survey, params: GroundParams, context: Context, flying_height: FlyingHeight | None = None
) -> tuple[GroundSurface, Survey]:
    """Makes the surface that all rays are projected on."""
    height = params.height_m if params.height_m != "auto" else ground_height_m(survey.frames)
    if not any(survey.located):
        survey, level = with_any_height(survey)
        height = level if params.height_m == "auto" else height
    elif survey.elevation is None and height is None:
        survey, height = _as_measured(survey, flying_height, context)
    positions = _places(survey)
    enu = survey.work_frame.enu_from_geodetic(positions[:, 0], positions[:, 1], 0.0)[:, :2]
    if survey.elevation is not None:
        ground = _dem(survey, enu, context)
        context.recorder.log("info", f"ground from {survey.elevation.path}, {survey.elevation.vertical}")
    else:
        level = float(height or 0.0)
        top = frame_heights_m(survey, np.full(len(survey.frames), level))
        reach = _reach_m(survey, top - level)
        ground = flat_ground(survey.work_frame, level, float(np.abs(enu).max()) + reach)
        context.recorder.log("info", f"flat ground at {level:.2f} m above the ellipsoid")
    context.metric("ground.kind", ground.kind)
    return ground, survey


def _as_measured(survey: Survey, flown: FlyingHeight | None, context: Context) -> tuple[Survey, float]:
    """The survey at the height that its images say, and the ground's, where nothing else says it."""
    if flown is None or not np.isfinite(flown.above_ground_m):
        unasked = "nothing measures it" if flown is None else "their images do not show it"
        stage = ", or put the stage matching.flying_height before projection.ground" if flown is None else ""
        raise InputError(
            f"how high the frames flew above the ground is unknown, and {unasked}",
            file=survey.frames[0].path,
            fix=f"give --dem, or the ground's height with --ground-height METRES{stage}",
        )
    above = flown.above_ground_m
    context.warn(
        "height-estimated",
        "",
        (
            f"flying height above the ground estimated from the images: {above:.0f} m; heights and "
            "scale of the map rest on it; give --dem, or the ground's height with --ground-height METRES"
        ),
    )
    return with_heights_above_ground(survey, above)


def _reach_m(survey: Survey, heights_above_m: Floats) -> float:
    """How far from the nadir points a survey looks: three times a level frame's half extent."""
    known = heights_above_m[np.isfinite(heights_above_m)]
    height = float(known.max()) if known.size else 100.0
    return _MOST_FLAT_REACH * max(half_extent_m(c, max(height, 1.0)) for c in survey.cameras)


def _dem(survey: Survey, enu: Floats, context: Context) -> GroundSurface:
    assert survey.elevation is not None
    projection = MapProjection(dem_crs(survey.elevation))
    at = _places(survey)
    middle = dem_middle_x(survey.elevation)
    xy = projection.map_from_geodetic(at[:, 0], at[:, 1])
    xy[:, 0] = projection.unwrapped(xy[:, 0], middle)
    near = read_heights(survey.elevation, (*xy.min(axis=0), *xy.max(axis=0)))
    below = near.at(xy[:, 0], xy[:, 1])
    if np.isfinite(below).any():
        _compare_heights(survey, float(np.nanmedian(below)), context)
    low = float(np.nanmin(near.height_ellipsoidal_m, initial=np.nanmin(below)))
    above = frame_heights_m(survey, below[: len(survey.frames)]) - low
    reach = _reach_m(survey, above)
    corners = np.array([[e, n] for e in (enu[:, 0].min() - reach, enu[:, 0].max() + reach)
                        for n in (enu[:, 1].min() - reach, enu[:, 1].max() + reach)])  # fmt: skip
    lonlat = survey.work_frame.geodetic_from_enu(np.column_stack([corners, np.zeros(4)]))
    box = projection.map_from_geodetic(lonlat[:, 0], lonlat[:, 1])
    box[:, 0] = projection.unwrapped(box[:, 0], middle)
    metres = float(np.linalg.norm(corners[3] - corners[0]) / np.linalg.norm(box[3] - box[0]))
    finest_m = _NODE_PX * ground_pixel_m(survey.cameras, above)
    raster = read_heights(survey.elevation, (*box.min(axis=0), *box.max(axis=0)), finest_m / metres)
    if raster.outliers:
        warning = outliers_warning(raster.outliers, Path(survey.elevation.path))
        context.warn(warning.code, warning.frame, warning.text)
    spacing = max(finest_m, float(raster.pixel_y * metres))
    return relief(survey.work_frame, raster, corners[0], corners[3], spacing)


def _compare_heights(survey: Survey, dem_m: float, context: Context) -> None:
    """Warns of a DEM that lies far from where the frames' altitudes put the ground."""
    by_frames_m = ground_height_m(survey.frames)
    if by_frames_m is None or abs(dem_m - by_frames_m) <= _MOST_OFF_M:
        return
    side = "above" if dem_m > by_frames_m else "below"
    text = (
        f"the DEM lies {abs(dem_m - by_frames_m):.0f} m {side} the ground by the frames' altitudes: its "
        "heights may be in feet, of another place, or count from another level; convert them, or give "
        "--dem-offset METRES"
    )
    context.warn("dem-heights-off", "", text)


def _places(survey: Survey) -> Floats:
    """Longitudes and latitudes of the frames, and of the control points where no frame's is known, (n, 2)."""
    at = [(f.position.lon_deg, f.position.lat_deg) for f in survey.frames]
    if not any(survey.located):
        at += [(c.lon_deg, c.lat_deg) for c in survey.control]
    return np.array(at)
