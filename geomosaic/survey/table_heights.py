"""Heights and deviations of a table's items out of any column, unit and datum."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from pyproj import CRS

from geomosaic.arrays import Floats
from geomosaic.errors import InputError
from geomosaic.geodesy.ellipsoid import middle_of
from geomosaic.geodesy.heights import ellipsoidal_offsets_m, sea_level, unit_m, vertical_crs
from geomosaic.survey.model import Warn
from geomosaic.survey.table import ParsedTable

HEIGHTS: Final = ("height_ellipsoidal", "height_orthometric", "height")
_UP: Final = (*HEIGHTS, "height_above_ground", "sd_vertical")
_PLAN: Final = ("sd_horizontal", "sd_e", "sd_n", "sd")


def in_units_of(table: ParsedTable, crs: CRS | None, datum: CRS | None) -> tuple[ParsedTable, list[Warn]]:
    """The table with heights and deviations that state no unit in the CRS's, and what was assumed.

    Heights are in the unit of their datum, else of x and y; deviations are in that of their coordinates.

    Args: as `heights_of`.
    """
    own = None if crs is None else vertical_crs(crs)
    plan = crs.to_2d() if crs is not None and crs.is_projected else None
    plan_m = 1.0 if plan is None else unit_m(plan)
    counts = own or (datum if plan_m == 1.0 else plan)
    up_m = 1.0 if counts is None else unit_m(counts)
    units_m = dict.fromkeys(_UP, up_m) | dict.fromkeys(_PLAN, plan_m)
    units_m = {c: size_m for c, size_m in units_m.items() if c in table.unstated and size_m != 1.0}
    notes = []
    assumed = [c for c in units_m if own is None or c in _PLAN]
    if plan is not None and plan_m != 1.0 and assumed:
        text = (
            f"{table.path.name}: {', '.join(assumed)} without a unit count as "
            f"{plan.axis_info[-1].unit_name}, as x and y do: if they are metres, heights are too low and "
            "deviations too small; name them with a unit, such as height_m or height_ft"
        )
        notes.append(Warn("height-unit-assumed", "", text))
    return replace(table, factors={**table.factors, **units_m}), notes


def heights_of(
    table: ParsedTable, crs: CRS | None, lonlat: Floats, datum: CRS | None
) -> tuple[Floats, list[Warn]]:
    """Ellipsoidal heights (n,), NaN where unknown, and what was assumed; an unstated datum counts as theirs.

    Args: crs: that the table is given in, None where none is stated. datum: what heights count from that
    state nothing else.
    Raises: `InputError` when orthometric heights need a geoid grid that isn't installed.
    """
    has, name = table.factors, table.path.name
    columns = [c for c in HEIGHTS if c in has]
    column = next((c for c in columns if np.isfinite(table.numbers(c)).any()), None)
    if column is None:
        return np.full(len(table.lines), np.nan), []
    values = table.numbers(column)
    notes = []
    vertical = (None if crs is None else vertical_crs(crs)) or datum
    if column == "height_orthometric" and (vertical is None or not vertical.is_vertical):
        vertical = sea_level(*middle_of(lonlat))
        text = (
            f"{name}: orthometric heights without a stated geoid are taken as {vertical.name}s: the map may "
            "lie too high or low by decimetres; name the geoid with --height-datum"
        )
        notes.append(Warn("geoid-assumed", "", text))
    if column != "height_ellipsoidal" and vertical is not None:
        try:
            values = values + ellipsoidal_offsets_m(vertical, *lonlat.T)
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
    return values, notes
