"""What stands before the lines of a table: a coordinate reference system, the columns' names, comments."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Final

from geomosaic.doors.plain import shown
from geomosaic.errors import InputError
from geomosaic.geodesy.crs_names import StatedCrs, coded_crs, is_wkt, nearest_names, stated_crs
from geomosaic.survey.column_names import Aliases, column_of
from geomosaic.survey.table import Line, is_number, split

_LABEL: Final = re.compile(r"^coordinate\s*system\s*:\s*", re.IGNORECASE)
"""What Metashape writes before the CRS."""


def read_head(
    path: Path, lines: list[Line], aliases: Aliases, fix: str
) -> tuple[StatedCrs | None, list[Line]]:
    """The CRS of a file's first line, and the other lines: the columns' names first where they stand there.

    Comments before are left out, unless one is the CRS or names the columns. Without a CRS, the first of the
    lines names columns or is one of numbers.

    Args: fix: how a CRS is given, for the error.
    Raises: `InputError` for a first line that is none of these, with the names of systems most like it.
    """
    names: Line | None = None
    lines = [
        replace(line, text=_LABEL.sub("", line.text)) if _LABEL.match(line.text) else line for line in lines
    ]
    for i, line in enumerate(lines):
        if is_wkt(line.text):
            text, i = _whole_wkt(lines, i)
            line = replace(line, text=text)
            columns, crs = False, _crs(path, line, fix)
        else:
            columns = _names_columns(line, aliases, path)
            crs = None if columns or has_numbers(line) else _crs(path, line, fix)
        if crs is not None:
            after = lines[i + 1 :]
            named = bool(after) and _names_columns(after[0], aliases, path)
            return crs, after if names is None or named else [names, *after]
        if not line.comment:
            if names is None and not columns and not has_numbers(line):
                raise _unknown(path, line, aliases, fix)
            return None, lines[i:] if names is None or columns else [names, *lines[i:]]
        if columns:
            names = line
    return None, [] if names is None else [names]


def has_numbers(line: Line) -> bool:
    """Whether a line is one of a table's: two of its fields are numbers."""
    return sum(map(is_number, split(line.text, line.text))) > 1


def names_known(line: Line, aliases: Aliases, path: Path) -> list[str | None]:
    """Which known column each field of a line names, None where none."""
    return [column_of(name, aliases, path)[0] for name in split(line.text, line.text)]


def _names_columns(line: Line, aliases: Aliases, path: Path) -> bool:
    """Whether a line names two columns that are known."""
    return len({column for column in names_known(line, aliases, path) if column}) > 1


def _crs(path: Path, line: Line, fix: str) -> StatedCrs | None:
    """What a line says of a CRS; of a comment only a code, PROJ string or WKT counts."""
    try:
        found = coded_crs(line.text) if line.comment else stated_crs(line.text)
    except InputError as error:
        raise InputError(f"line {line.number}: {error.problem}", file=path, fix=fix) from error
    return None if found is None else replace(found, line=line.number)


def _whole_wkt(lines: list[Line], first: int) -> tuple[str, int]:
    """A WKT that begins in a line, and the line it ends in."""
    text, last = lines[first].text, first
    while text.count("[") > text.count("]") and last + 1 < len(lines):
        last += 1
        text += lines[last].text
    return text, last


def _some(aliases: Aliases) -> str:
    """The first columns of a table, as a header names them."""
    return ",".join(name for name in ("name", "frame", "lon", "lat", "height") if name in aliases)


def _unknown(path: Path, line: Line, aliases: Aliases, fix: str) -> InputError:
    near = nearest_names(line.text)
    return InputError(
        f"line {line.number}: {shown(line.text)} names no columns and no known coordinate reference system",
        file=path,
        fix=f"did you mean {near}? Else {fix}"
        if near
        else f"name the columns in English, such as {_some(aliases)}; or {fix}",
    )
