"""Steps of reading a survey that concern its place: control points, DEM, work frame and the map's CRS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pyproj import CRS

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.errors import InputError
from geomosaic.geodesy.crs_names import label, required_crs
from geomosaic.geodesy.ellipsoid import middle_of
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection, map_crs, one_operation, utm_crs
from geomosaic.survey.control_use import lonlat_of_control, used_control
from geomosaic.survey.datum_shift import check_shift
from geomosaic.survey.draft import SurveyDraft
from geomosaic.survey.elevation import read_elevation
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.model import ControlPoint, Position, Warn
from geomosaic.survey.names import FrameNames
from geomosaic.survey.observations import observe
from geomosaic.survey.places import check_area
from geomosaic.survey.zone import proposing_zone

_OUT_OF_SCALE = tuned(0.01, "share", "of lengths: less warns of national grids; more hides wrong measures")


def with_control(draft: SurveyDraft) -> SurveyDraft:
    """The control points that can be used; where no frame has a position, all lie amid them.

    Raises: `InputError` for what needs a place on the Earth, where the survey has none.
    """
    with proposing_zone([h.path for h in draft.headers], draft.near.tolist()):
        file = draft.inputs.control(FrameNames(draft.names), draft.near)
    if file is not None:
        sizes = {h.name: (h.width_px, h.height_px) for h in draft.headers}
        optional = draft.inputs.gcp_optional
        control, warnings = used_control(file, draft.near, sizes, optional=optional)
        draft = replace(draft, control=control, control_warnings=tuple(warnings))
    if draft.without_place:
        _check_no_place_needed(draft.inputs)
    elif not draft.located:
        amid = middle_of(lonlat_of_control(draft.control))
        draft = replace(draft, observed=observe(draft.headers, draft.pos, anywhere=amid))
    return draft


def _check_no_place_needed(inputs: SurveyInputs) -> None:
    for needed, what in (
        (inputs.crs != "auto", f"there can be no map in {inputs.crs}"),
        (inputs.dem is not None, "a DEM cannot be used"),
    ):
        if needed:
            raise InputError(
                f"no frame has a position: {what}",
                file=inputs.frames,
                fix="give positions with --pos or control points with --gcp",
            )


def with_elevation(draft: SurveyDraft) -> SurveyDraft:
    """The DEM as an elevation model, and its heights under the frames."""
    if draft.inputs.dem is None:
        return draft
    positions, anywhere = draft.observed.positions, not draft.located
    under = [name for name, p in zip(draft.names, positions, strict=True) if p.known or anywhere]
    offset_m, datum = draft.inputs.dem_offset_m, draft.inputs.datum
    model, heights_m, warnings = read_elevation(draft.inputs.dem, offset_m, under, draft.lonlat, datum)
    return replace(draft, elevation=model, heights_m=heights_m, dem_warnings=tuple(warnings))


def with_work_frame(draft: SurveyDraft) -> SurveyDraft:
    """East, north and up at the survey's middle, at the height of the ground."""
    height_m = _ground_height_m(draft.observed.positions, draft.control, draft.heights_m)
    return replace(draft, work_frame=LocalFrame(*middle_of(draft.lonlat), height_m))


def _ground_height_m(
    positions: Sequence[Position], control: Sequence[ControlPoint], dem_heights_m: Floats
) -> float:
    known = dem_heights_m[np.isfinite(dem_heights_m)]
    if not known.size:
        known = np.array(
            [
                p.height_ellipsoidal_m - p.height_above_ground_m
                for p in positions
                if p.height_ellipsoidal_m is not None and p.height_above_ground_m is not None
            ]
        )
    if not known.size:
        known = np.array([c.height_ellipsoidal_m for c in control])
    return float(np.median(known)) if known.size else 0.0


def with_map_crs(draft: SurveyDraft) -> SurveyDraft:
    """The map's CRS: the one that is asked for, else the UTM zone of the middle."""
    middle = draft.work_frame.lon_deg, draft.work_frame.lat_deg
    if draft.inputs.crs != "auto":
        with proposing_zone((), [middle]):
            crs, warnings = _wanted_crs(draft.inputs.crs, middle)
        name = one_operation(crs.to_string(), draft.lonlat)
        return replace(draft, map_crs=name, crs_warnings=tuple(warnings))
    return draft if draft.without_place else replace(draft, map_crs=utm_crs(*middle))


def _wanted_crs(text: str, middle: tuple[float, float]) -> tuple[CRS, list[Warn]]:
    """A CRS, and what is to be known of it. Args: middle: of the map, longitude and latitude.

    Raises: `InputError` for a CRS that has no coordinates there.
    """
    crs = map_crs(text, middle)
    warnings = []
    if not required_crs(text, "").is_name_of(crs):
        taken = f"--crs '{text}' is taken as {label(crs)}; give its EPSG code if it is another"
        warnings.append(Warn("crs-by-name", "", taken))
    warnings += check_area(crs, *middle, "the frames")
    projection = MapProjection(crs.to_string())
    if not np.isfinite(projection.map_from_geodetic(*middle)).all():
        where = "{:.3f}, {:.3f} deg".format(*middle)
        fix = "give the EPSG code of a map projection of that place, such as EPSG:n"
        raise InputError(f"--crs '{text}' has no coordinates for the frames ({where})", fix=fix)
    scale = projection.scale_at(*middle)
    if abs(scale - 1.0) > _OUT_OF_SCALE:
        wrong = f"--crs '{text}': lengths and pixels on the map are {scale:.4g} times those on the ground"
        better = f"give a CRS that is true to scale there, such as {utm_crs(*middle)}"
        warnings.append(Warn("crs-out-of-scale", "", f"{wrong}; {better}"))
    return crs, [*warnings, *check_shift(crs, *middle, "--crs")]
