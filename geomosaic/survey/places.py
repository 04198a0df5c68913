"""Where a table's items lie: longitude, latitude and ellipsoidal height out of any columns and CRS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError

from geomosaic.errors import InputError
from geomosaic.geodesy.heights import ellipsoidal_offset_m, vertical_crs
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.model import Warn
from geomosaic.survey.table import Aliases, Table, read_lines

Floats = NDArray[np.float64]


def given_crs(path: Path, crs: str | None) -> CRS | None:
    """The CRS given, else that of a .prj file of the same name beside the file, else None."""
    prj = path.with_suffix(".prj")
    if crs is None and not prj.is_file():
        return None
    text = crs if crs is not None else " ".join(line.text for line in read_lines(prj))
    try:
        return CRS.from_user_input(text)
    except CRSError as error:
        raise InputError(
            f"'{text[:60]}' is no coordinate reference system",
            file=None if crs is not None else prj,
            mend="give an EPSG code such as EPSG:32632",
        ) from error


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


def lonlat_of(table: Table, crs: CRS | None) -> tuple[Floats, MapProjection | None]:
    """WGS 84 longitudes and latitudes (n, 2), and the projection of x and y if the table has those.

    Raises: `InputError` naming the line of a value out of range, or columns that are swapped.
    """
    if {"lon", "lat"} <= table.factors.keys():
        lonlat = np.array([[table.required(r, "lon"), table.required(r, "lat")] for r in table.rows])
        projection = None
    else:
        xy = np.array([[table.required(r, "x"), table.required(r, "y")] for r in table.rows])
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
    return lonlat, projection


def _check_range(table: Table, lonlat: Floats) -> None:
    if not np.isfinite(lonlat).all():
        line = table.rows[int(np.argmin(np.isfinite(lonlat).all(axis=1)))].line
        raise InputError(
            f"line {line}: the position lies outside the area of its coordinate system",
            file=table.path,
            mend="check the columns and --pos-crs",
        )
    lat_bad, lon_bad = np.abs(lonlat[:, 1]) > 90.0, np.abs(lonlat[:, 0]) > 180.0
    if lat_bad.all() and (np.abs(lonlat[:, 0]) <= 90.0).all() and (np.abs(lonlat[:, 1]) <= 180.0).all():
        raise InputError(
            f"longitude and latitude are swapped (line {table.rows[0].line}: latitude {lonlat[0, 1]:g})",
            file=table.path,
            mend="exchange the two columns or their names",
        )
    nowhere = (lonlat == 0.0).all(axis=1)
    if nowhere.any():
        raise InputError(
            f"line {table.rows[int(np.argmax(nowhere))].line}: longitude and latitude are both 0, "
            "as written by a receiver without a fix",
            file=table.path,
            mend="correct them, or take the line and its frame out",
        )
    for bad, axis, name, limit in ((lat_bad, 1, "latitude", 90), (lon_bad, 0, "longitude", 180)):
        if bad.any():
            i = int(np.argmax(bad))
            raise InputError(
                f"line {table.rows[i].line}: {name} {lonlat[i, axis]:g} is outside -{limit} to {limit}",
                file=table.path,
                mend="correct it (decimal degrees), or name the columns x and y and give --pos-crs",
            )


def heights_of(table: Table, crs: CRS | None, lonlat: Floats) -> tuple[list[float | None], list[Warn]]:
    """Ellipsoidal heights and what was assumed; heights of an unstated datum are taken as they are.

    Raises: `InputError` when orthometric heights need a geoid grid that isn't installed.
    """
    has, name = table.factors, table.path.name
    column = next((c for c in ("height_ellipsoidal", "height_orthometric", "height") if c in has), None)
    if column is None:
        return [None] * len(table.rows), []
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
    values = [table.number(row, column) for row in table.rows]
    return [None if v is None else v + offset for v in values], notes
