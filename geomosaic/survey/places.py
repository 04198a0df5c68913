"""Where a table's items lie: longitude, latitude and ellipsoidal height out of any columns and CRS."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError

from geomosaic.constants import CHOSEN, Because
from geomosaic.doors.files import read_text
from geomosaic.doors.plain import shown
from geomosaic.errors import InputError
from geomosaic.geodesy.heights import ellipsoidal_offset_m, vertical_crs
from geomosaic.geodesy.mapcrs import MapProjection, outside_area_m
from geomosaic.survey.model import Warn
from geomosaic.survey.table import Aliases, Table

Floats = NDArray[np.float64]
_PRJ_BYTES: Annotated[
    int,
    Because(
        "bytes", "of a .prj file: a CRS in words has some thousand, a larger file is something else", CHOSEN
    ),
] = 64 << 10
_FAR_OUTSIDE_M: Annotated[
    float,
    Because(
        "m",
        "outside a CRS's area of use from which it is another place's: areas are rounded boxes, and a "
        "neighbouring zone may be wanted (UTM's are up to 668 km wide); with more a wrong zone passes",
        CHOSEN,
    ),
] = 500_000.0


def given_crs(path: Path, crs: str | None) -> CRS | None:
    """The CRS given, else that of a .prj file of the same name beside the file, else None."""
    prj = path.with_suffix(".prj")
    if crs is None and not prj.is_file():
        return None
    text = (
        crs
        if crs is not None
        else read_text(prj, _PRJ_BYTES, "a .prj file", "give the CRS as WKT, or remove it").strip()
    )
    try:
        return CRS.from_user_input(text)
    except CRSError as error:
        raise InputError(
            f"{shown(text)} is no coordinate reference system",
            file=None if crs is not None else prj,
            mend="give an EPSG code such as EPSG:32632",
        ) from error


def check_area(crs: CRS, lon_deg: float, lat_deg: float, what: str, file: Path | None = None) -> list[Warn]:
    """Whether a CRS is of use where something lies: `InputError` where it isn't by far, near by a warning.

    Args: what lies at lon_deg, lat_deg, and the file that says so, for the message.
    """
    away_m = outside_area_m(crs, lon_deg, lat_deg)
    if away_m == 0.0:
        return []
    area = crs.area_of_use
    assert area is not None
    reach = f"{area.west:g} to {area.east:g}, {area.south:g} to {area.north:g} deg"
    problem = (
        f"{what} ({lon_deg:.3f}, {lat_deg:.3f} deg) lie {away_m / 1000.0:,.0f} km outside the area of "
        f"{crs.name} ({reach})"
    )
    if away_m > _FAR_OUTSIDE_M:
        raise InputError(problem, file=file, mend="give the coordinate reference system that belongs to them")
    return [Warn("crs-outside-area", "", f"{problem}; distances on the map may be wrong")]


def check_columns(table: Table, aliases: Aliases, item: str, what: str) -> None:
    """A table names its items and has longitude and latitude, or x and y; `InputError` if it doesn't."""
    has = table.factors.keys()
    wanted = [(item, what)]
    if not ({"lon", "lat"} <= has or {"x", "y"} <= has):
        grid = bool({"x", "y"} & has) and not {"lon", "lat"} & has
        wanted += (
            [("x", "easting"), ("y", "northing")] if grid else [("lon", "longitude"), ("lat", "latitude")]
        )
    for column, meaning in wanted:
        if column not in has:
            found = ", ".join([*has, *table.unknown_columns])
            raise InputError(
                f"no column for the {meaning} (found: {found})",
                file=table.path,
                mend=f"name it one of: {', '.join(aliases[column])}",
            )


def lonlat_of(table: Table, crs: CRS | None) -> tuple[Floats, MapProjection | None, list[Warn]]:
    """WGS 84 longitudes and latitudes (n, 2), the projection of x and y if the table has those, and doubts.

    Raises: `InputError` naming the line of a value out of range, or columns that are swapped.
    """
    if {"lon", "lat"} <= table.factors.keys():
        lonlat = np.column_stack([table.required("lon"), table.required("lat")])
        projection = crs = None
    else:
        xy = np.column_stack([table.required("x"), table.required("y")])
        if crs is None:
            example = "EPSG:4326" if (np.abs(xy) <= [180.0, 90.0]).all() else "EPSG:32632"
            raise InputError(
                "x and y have no coordinate reference system",
                file=table.path,
                mend=f"give it (--pos-crs {example}) or put a .prj file beside it",
            )
        if crs.is_geographic:
            _check_range(table, xy)
        horizontal = MapProjection(crs.to_2d().to_wkt())
        projection = None if crs.is_geographic else horizontal
        lonlat = horizontal.geodetic_from_map(*xy.T)
    _check_range(table, lonlat)
    lon, lat = np.median(lonlat, axis=0)
    notes = [] if crs is None else check_area(crs, lon, lat, "the positions", table.path)
    return lonlat, projection, notes


def _check_range(table: Table, lonlat: Floats) -> None:
    if not np.isfinite(lonlat).all():
        line = table.lines[int(np.argmin(np.isfinite(lonlat).all(axis=1)))]
        raise InputError(
            f"line {line}: the position lies outside the area of its coordinate system",
            file=table.path,
            mend="check the columns and --pos-crs",
        )
    lat_bad, lon_bad = np.abs(lonlat[:, 1]) > 90.0, np.abs(lonlat[:, 0]) > 180.0
    if lat_bad.all() and (np.abs(lonlat[:, 0]) <= 90.0).all() and (np.abs(lonlat[:, 1]) <= 180.0).all():
        raise InputError(
            f"longitude and latitude are swapped (line {table.lines[0]}: latitude {lonlat[0, 1]:g})",
            file=table.path,
            mend="exchange the two columns or their names",
        )
    nowhere = (lonlat == 0.0).all(axis=1)
    if nowhere.any():
        raise InputError(
            f"line {table.lines[int(np.argmax(nowhere))]}: longitude and latitude are both 0, "
            "as written by a receiver without a fix",
            file=table.path,
            mend="correct them, or take the line and its frame out",
        )
    for bad, axis, name, limit in ((lat_bad, 1, "latitude", 90), (lon_bad, 0, "longitude", 180)):
        if bad.any():
            i = int(np.argmax(bad))
            raise InputError(
                f"line {table.lines[i]}: {name} {lonlat[i, axis]:g} is outside -{limit} to {limit}",
                file=table.path,
                mend="correct it (decimal degrees), or name the columns x and y and give --pos-crs",
            )


def heights_of(table: Table, crs: CRS | None, lonlat: Floats) -> tuple[Floats, list[Warn]]:
    """Ellipsoidal heights (n,), NaN where unknown, and what was assumed; an unstated datum counts as theirs.

    Raises: `InputError` when orthometric heights need a geoid grid that isn't installed.
    """
    has, name = table.factors, table.path.name
    column = next((c for c in ("height_ellipsoidal", "height_orthometric", "height") if c in has), None)
    if column is None:
        return np.full(len(table.lines), np.nan), []
    offset, notes = 0.0, []
    vertical = vertical_crs(crs) if crs is not None and "lon" not in has else None
    if column == "height_orthometric" and vertical is None:
        vertical = CRS.from_epsg(3855)
        text = f"{name}: orthometric heights have no stated geoid, taken as EGM2008's"
        notes.append(Warn("geoid-assumed", "", text))
    if column != "height_ellipsoidal" and vertical is not None:
        try:
            offset = ellipsoidal_offset_m(vertical, *np.median(lonlat, axis=0))
        except InputError as error:
            raise InputError(
                error.problem,
                file=table.path,
                mend="give ellipsoidal heights (height_ellipsoidal_m), or install proj-data",
            ) from error
    elif column == "height":
        text = f"{name}: heights have no stated datum, taken as ellipsoidal"
        notes.append(Warn("height-datum-assumed", "", text))
    return table.numbers(column) + offset, notes
