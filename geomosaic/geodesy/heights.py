"""Vertical datums: what to add to a height above a geoid to have the height above the ellipsoid."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from pyproj import CRS
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError
from pyproj.transformer import AreaOfInterest, TransformerGroup

from geomosaic.arrays import Floats
from geomosaic.constants import sourced
from geomosaic.doors.unwarned import unwarned
from geomosaic.errors import InputError
from geomosaic.geodesy.egm96 import undulation_m
from geomosaic.geodesy.ellipsoid import longitudes_near

ELLIPSOIDAL: Final = "ellipsoidal"
LENGTHS_M = sourced(
    {
        **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
        **dict.fromkeys(("ft", "feet", "foot", "international_foot"), 0.3048),
        **dict.fromkeys(("ftus", "us_ft", "usft", "us_survey_feet", "us_survey_foot"), 1200.0 / 3937.0),
    },
    "m",
    "units of length, as files, GDAL and PROJ call them",
    "definitions; international foot of 1959, US survey foot of 1893",
)
_FOOT: Final = re.compile(
    r"(?P<before>((us|u_s|survey|international|intl)_)*)(foot|feet|ft)(?P<behind>(_(us|u_s|survey|international|intl))*)"
)
"""A foot's name with which of the two it is before or behind."""
GEOIDS = sourced({"EGM96": 5773, "EGM2008": 3855}, "EPSG", "vertical CRSs by their names", "EPSG dataset")


def vertical_crs(crs: CRS) -> CRS | None:
    """The vertical part of a CRS; the CRS itself where its heights are ellipsoidal; None without heights."""
    if crs.is_compound:
        return next((part for part in crs.sub_crs_list if part.is_vertical), None)
    if crs.is_vertical or len(crs.axis_info) == 3:
        return crs
    if crs.source_crs is not None and crs.is_bound:
        return crs if crs.source_crs.is_vertical else vertical_crs(crs.source_crs)
    return None


def height_datum(text: str) -> CRS:
    """The vertical CRS of a name such as `EGM96` or `EPSG:7837`; of `ellipsoidal` WGS 84 with its heights.

    Raises: `InputError` for anything else.
    """
    if text.lower() == ELLIPSOIDAL:
        return CRS.from_epsg(4979)
    fix = f"give {ELLIPSOIDAL}, {', '.join(GEOIDS)}, or the code of a vertical CRS such as EPSG:7837"
    try:
        crs = CRS.from_user_input(GEOIDS.get(text.upper(), text))
    except CRSError as error:
        raise InputError(f"'{text}' is no vertical coordinate reference system", fix=fix) from error
    if not crs.is_vertical or crs.is_compound:
        raise InputError(f"'{crs.name}' is no vertical reference system", fix=fix)
    return crs


def height_datum_in_metres(text: str) -> CRS:
    """As `height_datum`. Raises: `InputError` also where it counts heights in another unit."""
    crs = height_datum(text)
    if unit_m(crs) != 1.0:
        fix = "give the code of one in metres, such as EPSG:5703 for NAVD88"
        raise InputError(f"'{crs.name}' counts heights in {crs.axis_info[-1].unit_name}", fix=fix)
    return crs


def unit_m(crs: CRS) -> float:
    """Metres a unit of a CRS's last axis: of its heights, or of x and y where it has none."""
    return float(crs.axis_info[-1].unit_conversion_factor)


def raster_unit_m(stated: str | None, crs: CRS) -> float:
    """Metres a unit of a raster's heights: as its band states it, else by the vertical part of its CRS."""
    metres, vertical = length_m(stated or ""), vertical_crs(crs)
    return metres or (1.0 if vertical is None else unit_m(vertical))


def length_m(unit: str) -> float | None:
    """Metres a unit of length of this name, None for another: `metre`, `us-ft`, `Foot_US`, `feet (US)`."""
    name = re.sub(r"[^a-z]+", "_", unit.lower()).strip("_")
    if name not in LENGTHS_M and (foot := _FOOT.fullmatch(name)):
        of_survey = any(foot[side] and "int" not in foot[side] for side in ("before", "behind"))
        name = "us_survey_foot" if of_survey else "foot"
    return LENGTHS_M.get(name)


def sea_level(lon_deg: float, lat_deg: float) -> CRS:
    """The vertical CRS of heights above the sea at a place: EGM2008 if its grid is installed, else EGM96."""
    try:
        ellipsoidal_offset_m(CRS.from_epsg(GEOIDS["EGM2008"]), lon_deg, lat_deg)
    except InputError:
        return CRS.from_epsg(GEOIDS["EGM96"])
    return CRS.from_epsg(GEOIDS["EGM2008"])


def ellipsoidal_offset_m(vertical: CRS, lon_deg: float, lat_deg: float) -> float:
    """As `ellipsoidal_offsets_m`, at one point."""
    return float(ellipsoidal_offsets_m(vertical, np.array([lon_deg]), np.array([lat_deg]))[0])


def ellipsoidal_offsets_m(vertical: CRS, lon_deg: Floats, lat_deg: Floats) -> Floats:
    """Ellipsoidal minus orthometric height at points of any shape: the geoid's undulation, in metres.

    Only transformations with a stated operation count: a ballpark one, which leaves heights as they
    are, is never used. Among several the most accurate one whose grids are here is taken. EGM96 without
    PROJ's grid is the package's own.

    Args: a vertical CRS (`EPSG:5773`) in any unit, or one with ellipsoidal heights, whose offset is 0.
    Raises: `InputError` when its heights aren't counted upwards, or no geoid grid for it is installed.
    """
    axis = vertical.axis_info[-1]
    if axis.direction != "up":
        problem = f"heights of '{vertical.name}' are counted {axis.direction}"
        raise InputError(problem, fix="convert them to heights upwards first")
    if not vertical.is_vertical or "ellips" in vertical.name.lower():
        return np.zeros(lon_deg.shape)
    heights = CompoundCRS(name="heights of a vertical datum", components=["EPSG:4326", vertical])
    near = area_about(lon_deg, lat_deg)
    with unwarned(UserWarning):  # a better grid is missing: judged below
        group = TransformerGroup(
            heights, "EPSG:4979", always_xy=True, area_of_interest=near, allow_ballpark=False
        )
    for transformer in group.transformers:
        height = np.asarray(transformer.transform(lon_deg, lat_deg, np.zeros(lon_deg.shape))[2])
        if np.isfinite(height).all():
            return height
    if vertical.to_epsg() == GEOIDS["EGM96"]:
        return undulation_m(lon_deg, lat_deg)
    grids = missing_grids(group.unavailable_operations)
    if group.transformers and not grids:
        problem = f"the geoid model for '{vertical.name}' does not reach all of the places"
        raise InputError(problem, fix="take those far from the survey out")
    raise InputError(f"the geoid model for '{vertical.name}' is not installed", fix=installing(grids, "it"))


def area_about(lon_deg: Floats, lat_deg: Floats) -> AreaOfInterest:
    """Where PROJ is to choose its operation for places; west is above east where they cross 180 degrees."""
    lon = longitudes_near(lon_deg, float(lon_deg.flat[0]))
    west, east = ((x + 180.0) % 360.0 - 180.0 for x in (float(lon.min()) - 0.01, float(lon.max()) + 0.01))
    south, north = max(float(lat_deg.min()) - 0.01, -90.0), min(float(lat_deg.max()) + 0.01, 90.0)
    return AreaOfInterest(west, south, east, north)


def missing_grids(operations: Sequence[Any]) -> list[Any]:
    """PROJ's grids for the most accurate of the operations that lack the fewest grids, such as can be fetched
    first."""

    def rank(lacking_of: tuple[list[Any], Any]) -> tuple[bool, int, float]:
        grids, operation = lacking_of
        return not all(grid.url for grid in grids), len(grids), abs(operation.accuracy)

    lacking = [[grid for grid in op.grids if not grid.available] for op in operations]
    return min(zip(lacking, operations, strict=True), key=rank, default=([], None))[0]


def installing(grids: Sequence[Any], what: str) -> str:
    """How PROJ's grids are installed; what: they are called."""
    if grids and all(grid.url for grid in grids):
        fetches = (f"geomosaic geoid fetch {grid.short_name}" for grid in grids)
        return f"install {what}: {' && '.join(fetches)}"
    names = ", ".join(grid.short_name for grid in grids) or "its grid"
    return f"copy {names} into PROJ's data folder, which geomosaic doctor names"
