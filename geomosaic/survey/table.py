"""Tables in text files as surveyors have them: any separator, any order of columns, units in the header."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pyproj import CRS
from pyproj.exceptions import CRSError

from geomosaic.errors import FileError, InputError

Aliases = Mapping[str, tuple[str, ...]]
"""Column -> the names it goes by, in lower case with underscores and without units."""

_MAX_BYTES: Final = 64 << 20
_UNITS: Final = {
    **dict.fromkeys(("deg", "degree", "degrees", "decimal_degrees", "dd"), 1.0),
    **dict.fromkeys(("rad", "radian", "radians"), 180.0 / math.pi),
    **dict.fromkeys(("gon", "grad", "grads"), 0.9),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("ft", "feet"), 0.3048),
    **dict.fromkeys(("px", "pixel", "pixels", "s", "units"), 1.0),
}
_WANTED: Final = "give a table as text (CSV) with a line per frame or point, as docs/inputs.md has it"
_OTHER_KINDS: Final = (
    (rb"<.*<gpx\b|<gpx\b", "a GPX track"),
    (rb"<.*<kml\b|<kml\b", "a KML file"),
    (rb"<", "a file of tags (XML or HTML)"),
    (rb"[{\[].*\"FeatureCollection\"", "a GeoJSON file"),
    (rb"\{|\[\s*[{\[\"]", "a JSON file"),
    (rb"PK\x03\x04", "an archive or a spreadsheet"),
    (rb"\xff\xd8\xff|II\*\x00|MM\x00\*|\x89PNG", "a picture"),
)
_UNKNOWN: Final = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--"})
_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


@dataclass(frozen=True)
class Row:
    """One line of a table: its number in the file and its texts by column."""

    line: int
    texts: Mapping[str, str]


@dataclass(frozen=True)
class Table:
    """Columns that were known (with the factor to degrees or metres), those that weren't, and rows."""

    path: Path
    factors: Mapping[str, float]
    unknown_columns: tuple[str, ...]
    rows: tuple[Row, ...]

    def text(self, row: Row, column: str) -> str | None:
        """A text, None where the column or its content is missing."""
        value = row.texts.get(column, "").strip()
        return None if value.lower() in _UNKNOWN else value

    def number(self, row: Row, column: str) -> float | None:
        """A number in degrees or metres, None where unknown; `InputError` naming the line if it is none."""
        value = self.text(row, column)
        if value is None:
            return None
        plain = value.replace(",", ".") if value.count(",") == 1 and "." not in value else value
        if not _NUMBER.fullmatch(plain) or not math.isfinite(float(plain)):
            raise InputError(
                f"line {row.line}: '{value}' is no number for {column}",
                file=self.path,
                mend="write decimal numbers such as -12.5; leave the field empty where nothing is known",
            )
        return float(plain) * self.factors[column]

    def required(self, row: Row, column: str) -> float:
        """A number that must be there."""
        value = self.number(row, column)
        if value is None:
            raise InputError(
                f"line {row.line}: no {column}", file=self.path, mend="fill it in or remove the line"
            )
        return value


@dataclass(frozen=True)
class Line:
    """A line with content; a comment's mark is taken off."""

    number: int
    text: str
    comment: bool


def read_lines(path: Path) -> list[Line]:
    """Lines with content of a text file: UTF-8 or UTF-16 with or without a mark, else Latin-1.

    Raises: `FileError`, saying what it is instead of a table.
    """
    if path.is_dir():
        raise FileError("is a folder, no table", file=path, mend=_WANTED)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise FileError("is too large for a table (64 MB)", file=path, mend="is it the right file?")
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise FileError("there is no such file", file=path, mend="check the path") from error
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"can't be read ({error.strerror})", file=path) from error
    if kind := _other_kind(data[:4096]):
        raise FileError(f"is {kind}, no table", file=path, mend=_WANTED)
    try:
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    if "\x00" in text:
        raise FileError("is no text file", file=path, mend=_WANTED)
    lines = []
    for number, raw in enumerate(text.splitlines(), start=1):
        stripped = raw.strip()
        bare = re.sub(r"^(#+|//+)\s*", "", stripped)
        if bare:
            lines.append(Line(number, bare, bare != stripped))
    return lines


def _other_kind(start: bytes) -> str | None:
    """What a file is that is often taken for a table, by its first bytes."""
    bare = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    found = (kind for mark, kind in _OTHER_KINDS if re.match(mark, bare, re.DOTALL | re.IGNORECASE))
    return next(found, None)


def crs_of_line(text: str) -> CRS | None:
    """The CRS that OpenDroneMap's files have in their first line; None where the line is none.

    `EPSG:32616`, a PROJ string, or `WGS84 UTM 16N`.
    """
    utm = re.fullmatch(r"WGS\s?84\s+UTM\s+(\d{1,2})\s*([NS])", text.strip(), re.IGNORECASE)
    if utm and 1 <= int(utm[1]) <= 60:
        return CRS.from_epsg((32600 if utm[2].upper() == "N" else 32700) + int(utm[1]))
    if re.match(r"(epsg:\d+|\+proj=\w+)", text.strip(), re.IGNORECASE):
        try:
            return CRS.from_user_input(text.strip())
        except CRSError:
            return None
    return None


def split(text: str, like: str) -> list[str]:
    """Fields of a line, separated as the line `like` is: semicolon, tab, comma, or blanks."""
    separator = next((s for s in ";\t," if s in like), " ")
    quote = "'" if like.lstrip().startswith("'") else '"'
    try:
        fields = next(csv.reader([text], delimiter=separator, quotechar=quote, skipinitialspace=True))
    except (csv.Error, StopIteration):
        return [text]
    return [field.strip().strip(quote) for field in fields]


def column_of(name: str, aliases: Aliases, path: Path | None = None) -> tuple[str | None, float]:
    """Which column a header's name means, and the factor of its unit; (None, 1) where unknown.

    A unit stands in brackets or parentheses, or at the name's end: `Yaw [degrees]`, `omega_rad`.
    """
    match = re.fullmatch(r"([^\[(]*)[\[(]([^\])]*)[\])]?\s*", name)
    stem, unit = (match[1], _plain(match[2])) if match else (name, "")
    stem = _plain(stem)
    by_name = {alias: column for column, names in aliases.items() for alias in names}
    if stem not in by_name and not unit:
        stem, unit = next(((stem[: -len(u) - 1], u) for u in _UNITS if stem.endswith(f"_{u}")), (stem, unit))
    column = by_name.get(stem)
    if column is None:
        return None, 1.0
    if unit and unit not in _UNITS:
        raise InputError(
            f"column '{name}' has the unknown unit '{unit}'",
            file=path,
            mend=f"known: {', '.join(sorted(_UNITS))}",
        )
    return column, _UNITS.get(unit, 1.0)


def read_table(
    path: Path, lines: list[Line], aliases: Aliases, columns: tuple[str, ...] | None = None
) -> Table:
    """A table from a file's lines.

    The first line is the header, also behind a comment sign, unless `columns` gives the columns' names.
    """
    factors: dict[str, float] = {}
    unknown: list[str] = []
    if columns is None:
        if not lines:
            raise InputError("the table is empty", file=path, mend="give a header line and a line per item")
        header, lines = lines[0], lines[1:]
        like, known = header.text, []
        for name in split(header.text, like):
            column, factor = column_of(name, aliases, path)
            if column is not None and column in factors:
                raise InputError(f"two columns for {column}", file=path, mend=f"rename or remove '{name}'")
            if column is None:
                unknown.append(name)
            else:
                factors[column] = factor
            known.append(column)
    else:
        like = next((line.text for line in lines if not line.comment), "")
        known = [*columns]
        factors = dict.fromkeys(columns, 1.0)
    rows = []
    for line in lines:
        if line.comment:
            continue
        fields = split(line.text, like)
        while len(fields) > len(known) and not fields[-1]:
            fields.pop()
        if columns is None and len(fields) > len(known):
            raise InputError(
                f"line {line.number} has {len(fields)} fields under {len(known)} columns",
                file=path,
                mend="with decimal commas, separate the fields by semicolons",
            )
        texts = {c: f for c, f in zip(known, fields, strict=False) if c is not None}
        rows.append(Row(line.number, texts))
    if not rows:
        raise InputError("the table has a header and no lines", file=path, mend="give a line per item")
    return Table(path, factors, tuple(unknown), tuple(rows))


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
