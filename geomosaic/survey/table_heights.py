"""Ellipsoidal heights of a table's items out of any column, unit and datum."""

from __future__ import annotations

import numpy as np
from pyproj import CRS

from geomosaic.arrays import Floats
from geomosaic.errors import InputError
from geomosaic.geodesy.heights import ellipsoidal_offset_m, sea_level, unit_m, vertical_crs
from geomosaic.survey.model import Warn
from geomosaic.survey.table import ParsedTable


def heights_of(
    table: ParsedTable, crs: CRS | None, lonlat: Floats, datum: CRS | None
) -> tuple[Floats, list[Warn]]:
    """Ellipsoidal heights (n,), NaN where unknown, and what was assumed; an unstated datum counts as theirs.

    Args: crs: that the table is given in, None where none is stated. datum: what heights count from that
    state nothing else.
    Raises: `InputError` when orthometric heights need a geoid grid that isn't installed.
    """
    has, name = table.factors, table.path.name
    columns = [c for c in ("height_ellipsoidal", "height_orthometric", "height") if c in has]
    column = next((c for c in columns if np.isfinite(table.numbers(c)).any()), None)
    if column is None:
        return np.full(len(table.lines), np.nan), []
    values = table.numbers(column)
    offset, notes = 0.0, []
    own = None if crs is None else vertical_crs(crs)
    in_feet = crs is not None and crs.is_projected and unit_m(crs) != 1.0
    vertical, counts = own or datum, own or (crs if in_feet else datum)
    if counts is not None and column in table.unstated and (foot_m := unit_m(counts)) != 1.0:
        values = values * foot_m
        unit = counts.axis_info[-1].unit_name
        if own is None and in_feet:
            text = (
                f"{name}: heights state no unit and count as {unit}, as x and y do: if they are metres, "
                "the map lies too low; name the column height_m or height_ft"
            )
            notes.append(Warn("height-unit-assumed", "", text))
    if column == "height_orthometric" and (vertical is None or not vertical.is_vertical):
        vertical = sea_level(*np.median(lonlat, axis=0))
        text = (
            f"{name}: orthometric heights without a stated geoid are taken as {vertical.name}s: the map may "
            "lie too high or low by decimetres; name the geoid with --height-datum"
        )
        notes.append(Warn("geoid-assumed", "", text))
    if column != "height_ellipsoidal" and vertical is not None:
        try:
            offset = ellipsoidal_offset_m(vertical, *np.median(lonlat, axis=0))
        except InputError as error:
            fix = f"give ellipsoidal heights in a column height_ellipsoidal_m, or {error.fix}"
            raise InputError(error.problem, file=table.path, fix=fix) from error
    elif column == "height":
        text = (
            f"{name}: heights have no stated datum and are taken as ellipsoidal: the map may lie "
            "too high or low by a constant; name what they count from with --height-datum, or the column "
            "height_ellipsoidal or height_orthometric"
        )
        notes.append(Warn("height-datum-assumed", "", text))
    return values + offset, notes
