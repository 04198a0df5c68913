"""What the columns of a table mean by their names, and in which units."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from geomosaic.constants import sourced
from geomosaic.doors.plain import shown
from geomosaic.errors import InputError
from geomosaic.geodesy.heights import LENGTHS_M
from geomosaic.survey.column_languages import DEGREES, ENGLISH, METRES, plain

Aliases = Mapping[str, tuple[str, ...]]
"""Column -> the names it goes by, in lower case with underscores and without units."""

UNITS = sourced(
    {
        **dict.fromkeys(("deg", "degree", "degrees", "decimal_degrees", "dd"), 1.0),
        **dict.fromkeys(("rad", "radian", "radians"), 180.0 / math.pi),
        **dict.fromkeys(("gon", "grad", "grads"), 0.9),
        **LENGTHS_M,
        "mm": 0.001,
        "cm": 0.01,
        **dict.fromkeys(("px", "pixel", "pixels", "s", "units"), 1.0),
    },
    "degrees or metres by unit",
    "other units are refused",
    "definitions",
)
ANGLES: Final = frozenset(
    (
        "lon",
        "lat",
        "yaw",
        "pitch",
        "roll",
        "gimbal_yaw",
        "gimbal_pitch",
        "gimbal_roll",
        "omega",
        "phi",
        "kappa",
    )
)
"""Columns that no unit of length fits."""
_NO_UNITS: Final = frozenset(
    (
        "wgs84",
        "wgs_84",
        "n",
        "e",
        "s",
        "w",
        "x",
        "y",
        "z",
        "north",
        "east",
        "msl",
        "amsl",
        "ellipsoidal",
        "orthometric",
    )
)
"""What stands in brackets besides units: a system, an axis, what heights count from."""
_IN_PIXELS: Final = {"x": "col", "y": "row"}
"""What columns are whose unit is a pixel."""
_SECOND_NAMES: Final = frozenset(("frame", "name"))
"""Columns that tables have twice."""
_BRACKETS: Final = re.compile(r"[\[(]([^\])]*)[\])]?")


def column_of(name: str, aliases: Aliases, path: Path | None = None) -> tuple[str | None, str]:
    """Which column a header's name means, None where unknown, and its unit, "" where it states none.

    A unit stands in brackets or parentheses, or at the name's end: `Yaw [degrees]`, `omega_rad`. Other words
    in brackets belong to the name, or say nothing: `Altitude (AMSL) [m]`, `Latitude (WGS84)`. Names of other
    languages are those of `column_languages`.
    """
    english = {alias: column for column, names in aliases.items() for alias in names}
    others = {name: english[its] for name, its in ENGLISH.items() if its in english}
    by_name = {**others, **english}
    inside = [plain(text) for text in _BRACKETS.findall(name)]
    unit = next((text for text in inside if text not in _NO_UNITS), "")
    bare = plain(_BRACKETS.sub(" ", name))
    whole = plain("_".join([bare, *(text for text in inside if text in _NO_UNITS)]))
    stem = whole if whole in by_name else bare
    if stem not in by_name and not unit:
        ends = ((stem.removesuffix(f"_{u}"), u) for u in UNITS)
        stem, unit = next((its for its in ends if its[0] in by_name), (stem, unit))
    column = by_name.get(stem)
    if column is None:
        return None, ""
    if unit in METRES or (unit in DEGREES and (stem not in english or unit not in UNITS)):
        unit = "m" if unit in METRES else "deg"
    if column in ("lon", "lat") and {"w", "s"} & {*inside}:
        fix = "name it longitude or latitude, and give western and southern degrees a minus sign"
        raise InputError(f"column {shown(name)} counts to the west or the south", file=path, fix=fix)
    if unit and unit not in UNITS:
        raise InputError(
            f"column {shown(name)} has the unknown unit {shown(unit)}",
            file=path,
            fix=f"known: {', '.join(sorted(UNITS))}",
        )
    if column in ANGLES and unit in LENGTHS_M:
        problem = f"column {shown(name)} is an angle in {shown(unit)}"
        raise InputError(problem, file=path, fix="rename it: minutes of an angle are not read; write degrees")
    return column, unit


def columns_of(names: Sequence[str], aliases: Aliases, path: Path) -> list[tuple[str | None, str]]:
    """`column_of` each name of a header. Of two columns of names, such as a path and a file's name, that of
    the first alias counts, and the other is unknown. x and y in pixels are col and row, unless these are
    there.

    Raises: `InputError` for two columns that mean the same.
    """
    found = [column_of(name, aliases, path) for name in names]
    there = {its for its, _ in found}
    for i, (its, unit) in enumerate(found):
        if its in _IN_PIXELS and unit in ("px", "pixel", "pixels"):
            mark = _IN_PIXELS[its]
            found[i] = (mark if mark in aliases and mark not in there else None, "")
    for column in {its for its, _ in found if its is not None}:
        which = [i for i, (its, _) in enumerate(found) if its == column]
        if column in _SECOND_NAMES:
            best = min(which, key=lambda i: [*aliases[column], plain(names[i])].index(plain(names[i])))
            found = [(None, "") if i in which and i != best else its for i, its in enumerate(found)]
        elif len(which) > 1:
            fix = f"rename or remove '{names[which[1]]}'"
            raise InputError(f"two columns for {column}", file=path, fix=fix)
    return found
