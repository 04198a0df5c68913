"""Where a table's items lie: longitude and latitude out of any columns and CRS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from geomosaic.arrays import Floats
from geomosaic.constants import ENOUGH, sourced, tuned
from geomosaic.doors.files import TEXT_BYTES, read_text
from geomosaic.doors.plain import shown
from geomosaic.errors import InputError
from geomosaic.geodesy.crs_names import AmbiguousCrsError, StatedCrs, crs_of, label, required_crs
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m, middle_of
from geomosaic.geodesy.heights import unit_m
from geomosaic.geodesy.mapcrs import MapProjection, one_operation, outside_area_m
from geomosaic.survey.accuracy import CONTROL
from geomosaic.survey.column_languages import DIRECTIONS, plain
from geomosaic.survey.column_names import Aliases
from geomosaic.survey.datum_shift import check_shift
from geomosaic.survey.degrees import LETTERS
from geomosaic.survey.model import Warn
from geomosaic.survey.table import ParsedTable

_FAR_OUTSIDE_M = tuned(500_000.0, "m", "off a CRS's area: less refuses next zones; more accepts wrong ones")
_FAR_M = tuned(5000.0, "m", "beyond the frames' reach: less refuses points; more accepts swapped columns")
_SAME_FOOT = sourced(1e-5, "of a foot", "feet of the US survey are 2 ppm longer", "NIST SP 811, B.6")
NOWHERE: Floats = np.column_stack([[], []])
"""Longitudes and latitudes of no frames: none has a position, or they aren't known yet."""


@dataclass(frozen=True)
class TablePlaces:
    """lonlat: longitudes and latitudes (n, 2) of a table, degrees in WGS 84. crs: that its coordinates or its
    heights are in, None where none is stated. projection: of x and y. notes: what was assumed."""

    lonlat: Floats
    crs: CRS | None
    projection: MapProjection | None
    notes: list[Warn]


def given_crs(path: Path, crs: str | None, fix: str) -> StatedCrs | None:
    """The CRS given, else that of a .prj file of the same name in its folder, else None."""
    prj = path.with_suffix(".prj")
    if crs is not None:
        return required_crs(crs, fix)
    if not prj.is_file():
        return None
    text = read_text(prj, TEXT_BYTES, "a .prj file", "give the CRS as WKT, or remove it")
    try:
        return required_crs(" ".join(text.split()), "give the CRS as WKT, or remove it")
    except InputError as error:
        raise InputError(error.problem, file=prj, fix=error.fix) from error


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
        raise InputError(problem, file=file, fix="give the coordinate reference system of the coordinates")
    text = f"{problem}; distances on the map may be wrong; give the CRS of the place"
    return [Warn("crs-outside-area", "", text)]


def check_columns(table: ParsedTable, aliases: Aliases, item: str, what: str) -> None:
    """A table names its items and has longitude and latitude, or x and y; `InputError` if it doesn't."""
    has = table.factors.keys()
    wanted = [(item, what)]
    if not ({"lon", "lat"} <= has or {"x", "y"} <= has):
        grid = {"x", "y"} & has and not {"lon", "lat"} & has
        axes = (("x", "easting"), ("y", "northing")) if grid else (("lon", "longitude"), ("lat", "latitude"))
        wanted += axes
    for column, meaning in wanted:
        if column not in has:
            found = ", ".join([*has, *table.unknown_columns])
            raise InputError(
                f"no column for the {meaning} (found: {found})",
                file=table.path,
                fix=f"name it one of: {', '.join(aliases[column])}",
            )


def places_of(table: ParsedTable, stated: StatedCrs | None, near: Floats, fix: str) -> TablePlaces:
    """Where the items of a table lie, by longitude and latitude, or by x and y in the CRS that is stated.

    Of several systems that a name may mean, and of both orders of x and y, the first that puts the items near
    the frames is taken. Where these have no position, it is the first in whose area of use the items lie.
    Longitudes and latitudes are in the geographic CRS that is stated, else in WGS 84. Columns of these names
    that hold eastings and northings are read as such. Heights of a table that has both are in the stated CRS.

    Args: near: longitudes and latitudes (k, 2) of the frames; fix: how a CRS is given, for errors.
    Raises: `AmbiguousCrsError` where systems are left that put the items at different places. `InputError`
    naming the line of a value out of range, columns that are swapped, or degrees in a map projection.
    """
    has = table.factors.keys()
    by_axes = {"x", "y"} <= has
    filled = all(np.isfinite(table.numbers(c)).any() for c in ("lon", "lat"))
    if {"lon", "lat"} <= has and (filled or not by_axes):
        lonlat = np.column_stack([_signed(table, "lon"), _signed(table, "lat")])
        meant = None if stated is None else _of_degrees(table, stated, lonlat)
        if stated is None or by_axes or meant is None:
            _check_range(table, lonlat)
            of_axes = stated.meant(stated.groups[0])[0] if stated is not None and by_axes else None
            return TablePlaces(lonlat, of_axes, None, [])
        return _in_crs(table, meant, lonlat, near, fix)
    if stated is None:
        raise InputError("x and y have no coordinate reference system", file=table.path, fix=fix)
    return _in_crs(table, stated, _in_its_unit(table, stated), near, fix)


def _of_degrees(table: ParsedTable, stated: StatedCrs, lonlat: Floats) -> StatedCrs | None:
    """What a stated CRS means for columns of longitude and latitude (n, 2); None where it is of others.

    Raises: `InputError` where the table states a map projection and holds degrees.
    """
    degrees = bool((np.abs(lonlat) <= 180.0).all())
    alike = [[c for c in group if crs_of(c).is_geographic == degrees] for group in stated.groups]
    groups = tuple(tuple(group) for group in alike if group)
    if groups:
        if degrees:
            _check_range(table, lonlat)
        return replace(stated, groups=groups)
    if degrees and stated.line is not None and not {"x", "y"} <= table.factors.keys():
        raise InputError(
            f"line {stated.line} states the map projection {shown(stated.text)}, and longitude and latitude "
            "are in degrees",
            file=table.path,
            fix="take that line out if they are in WGS 84, else state a system in degrees such as EPSG:4326",
        )
    return None


def _in_crs(table: ParsedTable, stated: StatedCrs, xy: Floats, near: Floats, fix: str) -> TablePlaces:
    """Where x and y (n, 2) lie, in the unit of the CRS that is stated."""
    try:
        crs, swapped = _chosen(stated, xy, near, fix)
    except AmbiguousCrsError as error:
        raise AmbiguousCrsError(error.problem, file=table.path, fix=fix) from error
    notes = []
    name = table.path.name
    if not stated.is_name_of(crs):
        text = f"{name}: {shown(stated.text)} is taken as {label(crs)}; give its EPSG code if it is another"
        notes.append(Warn("crs-by-name", "", text))
    if swapped:
        where = f"far from the frames in {crs.name}" if len(near) else f"outside the area of {crs.name}"
        text = (
            f"{name}: x is read as northing and y as easting: as they are written, the positions would "
            f"lie {where}; nothing to do if that CRS is right"
        )
        notes.append(Warn("xy-exchanged", "", text))
        xy = xy[:, ::-1]
    if crs.is_geographic:
        _check_range(table, xy)
    plan = crs.to_2d().to_wkt()
    lonlat = MapProjection(plan).geodetic_from_map(*xy.T)
    _check_range(table, lonlat)
    horizontal = MapProjection(one_operation(plan, near if len(near) else lonlat))
    lonlat = horizontal.geodetic_from_map(*xy.T)
    _check_range(table, lonlat)
    notes += check_area(crs, *middle_of(lonlat), "the positions", table.path)
    notes += check_shift(crs, *middle_of(near if len(near) else lonlat), name)
    return TablePlaces(lonlat, crs, None if crs.is_geographic else horizontal, notes)


def _signed(table: ParsedTable, column: str) -> Floats:
    """A column (n,) of degrees, negative where another column names the south or the west.

    Raises: `InputError` naming the line of a direction that is not known.
    """
    degrees, (positive, negative) = table.required(column), LETTERS[column]
    for row, text in enumerate(table.texts(f"{column}_ref")):
        direction = None if text is None else DIRECTIONS.get(plain(text), text)
        if direction == negative:
            degrees[row] = -abs(degrees[row])
        elif direction not in (None, positive):
            problem = f"{shown(direction)} is no known direction for {column}"
            raise table.error(row, problem, f"write {positive} or {negative}")
    return degrees


def _in_its_unit(table: ParsedTable, stated: StatedCrs) -> Floats:
    """x and y (n, 2) in the unit of the CRS, which is theirs where a column states none. Feet that a column
    states are the CRS's own, be they international or of the US survey."""
    crs = stated.meant(stated.groups[0])[0].to_2d()
    own_m = 1.0 if crs.is_geographic else unit_m(crs)
    columns = []
    for name in ("x", "y"):
        its_m = own_m if name in table.unstated else table.factors[name]
        its_m = own_m if np.isclose(its_m, own_m, rtol=_SAME_FOOT) else its_m
        columns.append(table.required(name) / table.factors[name] * (its_m / own_m))
    return np.column_stack(columns)


def _chosen(stated: StatedCrs, xy: Floats, near: Floats, fix: str) -> tuple[CRS, bool]:
    """The CRS that is meant, and whether x and y are exchanged."""
    degrees = bool((np.abs(xy) <= 180.0).all())
    every = [stated.meant(group) for group in stated.groups]
    alike = [[crs for crs in group if crs.is_geographic == degrees] for group in every]
    groups = [group for group in alike if group] or every
    some = xy[:: len(xy) // ENOUGH + 1]
    for frames in (near, NOWHERE) if len(near) else (NOWHERE,):
        for swapped in (False, True):
            for group in groups:
                at, margin_m = (some[:, ::-1], 0.0) if swapped else (some, _FAR_M)
                if fitting := _fitting(group, at, frames, margin_m):
                    _check_one_place(stated, fitting, fix)
                    return next(iter(fitting)), swapped
    return groups[0][0], False


def _fitting(group: Sequence[CRS], xy: Floats, near: Floats, margin_m: float) -> dict[CRS, Floats]:
    """The systems that put points near the frames, else in their area of use or so near to it, and where."""
    if len(near) and len(group) > 1:
        group = [crs for crs in group if outside_area_m(crs, *middle_of(near)) == 0.0]
    found = {crs: lonlat for crs in group if (lonlat := _lonlat(crs, xy)) is not None}
    if not len(near):
        return {c: at for c, at in found.items() if outside_area_m(c, *middle_of(at)) <= margin_m}
    reached = {}
    for crs, lonlat in found.items():
        away_m, reach_m = away_from(near, lonlat)
        if away_m.min() <= reach_m:
            reached[crs] = lonlat
    return reached


def _lonlat(crs: CRS, xy: Floats) -> Floats | None:
    """Longitudes and latitudes (n, 2); None where the CRS has no such coordinates."""
    try:
        lonlat = MapProjection(crs.to_2d().to_wkt()).geodetic_from_map(*xy.T)
    except InputError:
        return None
    degrees = xy if crs.is_geographic else lonlat
    return lonlat if (np.abs(degrees) <= [180.0, 90.0]).all() and np.isfinite(lonlat).all() else None


def _check_one_place(stated: StatedCrs, fitting: Mapping[CRS, Floats], fix: str) -> None:
    """`AmbiguousCrsError` where systems put points farther apart than points are known."""
    first, *others = fitting.values()
    apart = [np.linalg.norm(mid_latitude_offset_m(*first.T, *other.T), axis=1).max() for other in others]
    if max(apart, default=0.0) > CONTROL.sd_horizontal_m:
        raise stated.ambiguous(fitting, fix)


def away_from(near: Floats, lonlat: Floats) -> tuple[Floats, float]:
    """Distances (n,) of points from the frames' middle in metres, and how far away a point may lie."""
    middle = np.broadcast_to(np.median(near, axis=0), lonlat.shape)
    away_m = np.linalg.norm(mid_latitude_offset_m(*lonlat.T, *middle.T), axis=1)
    around = np.broadcast_to(middle[0], near.shape)
    return away_m, float(np.linalg.norm(mid_latitude_offset_m(*near.T, *around.T), axis=1).max()) + _FAR_M


def _check_range(table: ParsedTable, lonlat: Floats) -> None:
    if not np.isfinite(lonlat).all():
        row = int(np.argmin(np.isfinite(lonlat).all(axis=1)))
        problem = "the position lies outside the area of its coordinate system"
        raise table.error(row, problem, "check the columns and the coordinate reference system")
    lat_bad, lon_bad = np.abs(lonlat[:, 1]) > 90.0, np.abs(lonlat[:, 0]) > 180.0
    if lat_bad.all() and (np.abs(lonlat[:, 0]) <= 90.0).all() and (np.abs(lonlat[:, 1]) <= 180.0).all():
        raise InputError(
            f"longitude and latitude are swapped (line {table.lines[0]}: latitude {lonlat[0, 1]:g})",
            file=table.path,
            fix="exchange the two columns or their names",
        )
    nowhere = (lonlat == 0.0).all(axis=1)
    if nowhere.any():
        problem = "longitude and latitude are both 0, as a receiver writes without satellites"
        fix = "correct them, or take the line and its frame out"
        raise table.error(int(np.argmax(nowhere)), problem, fix)
    whole = np.array([np.pi, np.pi / 2.0])
    if (np.abs(lonlat) <= whole).all() and (np.abs(np.degrees(lonlat)) > whole).any():
        raise InputError(
            f"longitude and latitude look like radians (line {table.lines[0]}: {lonlat[0, 0]:g}, "
            f"{lonlat[0, 1]:g}): as degrees they would lie in the sea off Africa",
            file=table.path,
            fix="give decimal degrees, or name the columns lon_rad and lat_rad",
        )
    for bad, axis, name, limit in ((lat_bad, 1, "latitude", 90), (lon_bad, 0, "longitude", 180)):
        if bad.any():
            row = int(np.argmax(bad))
            fix = "correct it (decimal degrees), or name the columns x and y and give their CRS"
            raise table.error(row, f"{name} {lonlat[row, axis]:g} is outside -{limit} to {limit}", fix)
