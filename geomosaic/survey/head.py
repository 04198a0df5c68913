"""What stands before the lines of a table: a coordinate reference system, the columns' names, comments."""

from __future__ import annotations

from pathlib import Path

from geomosaic.doors.plain import shown
from geomosaic.errors import InputError
from geomosaic.geodesy.crs_names import StatedCrs, coded_crs, nearest_names, stated_crs
from geomosaic.survey.table import Aliases, Line, column_of, is_number, split


def read_head(
    path: Path, lines: list[Line], aliases: Aliases, mend: str
) -> tuple[StatedCrs | None, list[Line]]:
    """The CRS of a file's first line, and the other lines: the columns' names first where they stand there.

    Comments before are left out, unless one is the CRS or names the columns. Without a CRS, the first of the
    lines names columns or is one of numbers.

    Args: mend: how a CRS is given, for the error.
    Raises: `InputError` for a first line that is none of these, with the names of systems most like it.
    """
    names: Line | None = None
    for i, line in enumerate(lines):
        try:
            crs = None if has_numbers(line) else coded_crs(line.text) if line.comment else _crs(line, aliases)
        except InputError as error:
            raise InputError(f"line {line.number}: {error.problem}", file=path, mend=mend) from error
        if crs is not None:
            after = lines[i + 1 :]
            if names is None and after and _names_columns(after[0], aliases, path):
                return crs, after
            return crs, after if names is None else [names, *after]
        if not line.comment:
            if names is None and not _names_columns(line, aliases, path) and not has_numbers(line):
                raise _unknown(path, line, mend)
            return None, lines[i:] if names is None else [names, *lines[i:]]
        if names is None and _names_columns(line, aliases, path):
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


def _crs(line: Line, aliases: Aliases) -> StatedCrs | None:
    by_code = coded_crs(line.text)
    if by_code is not None or _names_columns(line, aliases, Path()):
        return by_code
    return stated_crs(line.text)


def _unknown(path: Path, line: Line, mend: str) -> InputError:
    near = nearest_names(line.text)
    return InputError(
        f"line {line.number}: {shown(line.text)} names no columns and no known coordinate reference system",
        file=path,
        mend=f"did you mean {near}? Else {mend}" if near else mend,
    )
