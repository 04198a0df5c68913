"""Tables in text files as surveyors have them: any separator, any order of columns, units in the header."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.doors.files import MOST_PARTS, TEXT_BYTES, decoded, read_bytes
from geomosaic.doors.plain import shown
from geomosaic.errors import FileError, InputError
from geomosaic.survey.column_languages import in_unicode
from geomosaic.survey.column_names import UNITS, Aliases, columns_of
from geomosaic.survey.degrees import degrees_of

_MOST_LINES = tuned(200_000, "lines", "the largest blocks have 50,000 frames: more is a log, or another file")
_MOST_COLUMNS = tuned(500, "columns", "of a header; each is looked up under every name")
_WANTED: Final = "give a table as text (CSV) with a header line and a line per frame or point"
_OTHER_KINDS: Final = (
    (rb"<.*<gpx\b|<gpx\b", "a GPX track"),
    (rb"<.*<kml\b|<kml\b", "a KML file"),
    (rb"<", "a file of tags (XML or HTML)"),
    (rb"[{\[].*\"FeatureCollection\"", "a GeoJSON file"),
    (rb"\{|\[\s*[{\[\"]", "a JSON file"),
    (rb"PK\x03\x04", "an archive or a spreadsheet"),
    (rb"\xff\xd8\xff|II\*\x00|MM\x00\*|\x89PNG", "an image"),
)
_UNKNOWN: Final = frozenset({"", "nan", "na", "n/a", "null", "none", "-", "--"})
_SEPARATOR_NAMED: Final = re.compile(r"sep=.", re.IGNORECASE)
"""The first line of a table that Excel is to open."""
_NUMBER: Final = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?", re.ASCII)
_COMMENT: Final = re.compile(r"#+\s*|//+(?!/|[^/\s]+/[^/\s])\s*")
"""A comment's mark; `//server/share` is a path."""
_IMAGES: Final = frozenset(("frame", "image"))
"""Columns of images' names, which may hold blanks."""
_IMAGE: Final = r"(\S.*?\.(?:jpe?g|tiff?|png|dng|hei[cf]))(?=\s|$)"
"""A name up to its extension."""


@dataclass(frozen=True)
class ParsedTable:
    """Columns that were known (with the factor to degrees or metres), those that weren't, and rows.

    lines: each row's line in the file. cells: each known column's texts, None where unknown. unstated: known
    columns whose names state no unit.
    """

    path: Path
    factors: Mapping[str, float]
    unknown_columns: tuple[str, ...]
    lines: tuple[int, ...]
    cells: Mapping[str, Sequence[str | None]]
    unstated: frozenset[str]

    def texts(self, column: str) -> Sequence[str | None]:
        """A column's texts, None where the column or its content is missing."""
        return self.cells.get(column) or [None] * len(self.lines)

    def numbers(self, column: str) -> Floats:
        """A column (n,) in degrees or metres, NaN where unknown; `InputError` names a line without one.

        Longitudes and latitudes may have minutes and seconds.
        """
        cells = self.cells.get(column)
        if cells is None:
            return np.full(len(self.lines), np.nan)
        values = []
        for i, text in enumerate(cells):
            if text is None:
                values.append(math.nan)
                continue
            plain = text.replace(",", ".") if text.count(",") == 1 and "." not in text else text
            value = float(plain) if _NUMBER.fullmatch(plain) else degrees_of(text, column)
            if value is None or not math.isfinite(value):
                fix = "write decimal numbers such as -12.5 (exiftool -n does); leave unknown fields empty"
                raise self.error(i, f"{shown(text)} is no number for {column}", fix)
            values.append(value)
        return np.array(values) * self.factors[column]

    def without(self, rows: Sequence[bool]) -> ParsedTable:
        """The table without some rows (n,)."""
        kept = [i for i, out in enumerate(rows) if not out]
        cells = {name: [texts[i] for i in kept] for name, texts in self.cells.items()}
        return replace(self, lines=tuple(self.lines[i] for i in kept), cells=cells)

    def required(self, column: str) -> Floats:
        """A column (n,) of numbers that must all be there."""
        values = self.numbers(column)
        if np.isnan(values).any():
            row = int(np.argmax(np.isnan(values)))
            raise self.error(row, f"no {column}", "fill it in or remove the line")
        return values

    def error(self, row: int, problem: str, fix: str) -> InputError:
        """What is wrong in a row, by its line."""
        return InputError(f"line {self.lines[row]}: {problem}", file=self.path, fix=fix)


@dataclass(frozen=True)
class Line:
    """A line with content; a comment's mark is taken off."""

    number: int
    text: str
    comment: bool


def read_lines(path: Path, item: str) -> list[Line]:
    """Lines with content of a text file, in any of the encodings of `doors.files.read_text` and `in_unicode`.

    Args: item: what a line is of, as in `lines of frames`.
    Raises: `FileError`, saying what it is instead of a table.
    """
    content = in_unicode(read_bytes(path, TEXT_BYTES, "a table", _WANTED))
    if kind := _other_kind(content[:4096]):
        raise FileError(f"is {kind}, no table", file=path, fix=_WANTED)
    found = decoded(content, path, _WANTED).splitlines()
    if len(found) > _MOST_LINES:
        problem = f"has {len(found):,} lines, more than {_MOST_LINES:,} {item}"
        raise FileError(problem, file=path, fix="is it the right file?")
    lines = []
    for number, raw in enumerate(found, start=1):
        if len(raw) > MOST_PARTS:
            problem = f"line {number} has {len(raw):,} characters"
            raise FileError(problem, file=path, fix=f"give lines of at most {MOST_PARTS:,} characters")
        stripped = raw.strip()
        mark = _COMMENT.match(stripped)
        bare = stripped[mark.end() :] if mark else stripped
        if bare and not (number == 1 and _SEPARATOR_NAMED.fullmatch(bare)):
            lines.append(Line(number, bare, bare != stripped))
    return lines


def _other_kind(start: bytes) -> str | None:
    """What a file is that is often taken for a table, by its first bytes."""
    bare = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    found = (kind for mark, kind in _OTHER_KINDS if re.match(mark, bare, re.DOTALL | re.IGNORECASE))
    return next(found, None)


def split(text: str, like: str) -> list[str]:
    """Fields of a line, separated as the line `like` is: semicolon, tab, comma, or blanks.

    Where blanks separate, tabs count as such, and a line without tabs in a table of tabs is one of blanks.
    """
    separator = _separator(like)
    if separator == "\t" and "\t" not in text:
        separator = " "
    if separator == " ":
        text = text.replace("\t", " ")
    quote = "'" if like.lstrip().startswith("'") else '"'
    if quote not in text:
        fields = text.split(separator)
        return [f.strip() for f in fields] if separator != " " else [f for f in fields if f]
    try:
        fields = next(csv.reader([text], delimiter=separator, quotechar=quote, skipinitialspace=True))
    except (csv.Error, StopIteration):
        return [text]
    return [field.strip().strip(quote) for field in fields]


def _separator(like: str) -> str:
    """What separates the fields of a line."""
    separator = next((s for s in ";\t," if s in like), " ")
    return " " if separator == "," and _has_decimal_commas(like) else separator


def _fields(text: str, like: str, count: int) -> list[str]:
    """Fields of one of a table's lines, of which some may have tabs and others blanks.

    A line with tabs has its fields between them where these are as many as the columns. Else blanks separate
    too if they do so in the line `like`, or where that gives as many and parts numbers only.
    """
    separator = _separator(like)
    if separator not in "\t " or "\t" not in text:
        return split(text, like)
    by_tabs = split(text, "\t")
    by_both = split(text, " ")
    joined = any(" " in field and all(map(is_number, field.split())) for field in by_tabs)
    blanks = len(by_tabs) != count and (separator == " " or (joined and len(by_both) == count))
    return by_both if blanks else by_tabs


def _has_decimal_commas(text: str) -> bool:
    """Whether the commas of a line are all decimal ones, its fields separated by blanks."""
    with_comma = [field for field in text.split() if "," in field]
    return len(with_comma) > 1 and all(re.fullmatch(r"[-+]?\d+,\d+", field, re.ASCII) for field in with_comma)


def quoted_image(text: str, before: int) -> str:
    """A line separated by blanks with the image's name in quotes where it holds blanks.

    Args: before: how many fields stand before the image.
    """
    found = re.match(rf"((?:\S+\s+){{{before}}}){_IMAGE}", text, re.IGNORECASE)
    if found is None or '"' in text or len(found[2].split()) == 1:
        return text
    return f'{found[1]}"{found[2]}"{text[found.end() :]}'


def is_number(text: str) -> bool:
    """Whether a field is a number, be it with a decimal comma."""
    return _NUMBER.fullmatch(text.replace(",", ".", 1)) is not None


def read_table(
    path: Path, lines: list[Line], aliases: Aliases, columns: tuple[str, ...] | None = None
) -> ParsedTable:
    """A table from a file's lines.

    The first line is the header, also behind a comment sign, unless `columns` gives the columns' names.
    """
    factors: dict[str, float] = {}
    unknown: list[str] = []
    unstated = set(columns or ())
    if columns is None:
        if not lines:
            raise InputError("the table is empty", file=path, fix="give a header line and a line per item")
        header, lines = lines[0], lines[1:]
        like, known = header.text, []
        names = split(header.text, like)
        if len(names) > _MOST_COLUMNS:
            problem = f"line {header.number} names {len(names):,} columns"
            raise InputError(problem, file=path, fix=f"give at most {_MOST_COLUMNS}")
        for name, (column, unit) in zip(names, columns_of(names, aliases, path), strict=True):
            if column is None:
                unknown.append(name)
            else:
                factors[column] = UNITS.get(unit, 1.0)
                unstated |= set() if unit else {column}
            known.append(column)
        first = next((line.text for line in lines if not line.comment), like)
        like = like if len(split(first, like)) > 1 else first
    else:
        like = next((line.text for line in lines if not line.comment), "")
        known = [*columns]
        factors = dict.fromkeys(columns, 1.0)
    image = next((i for i, column in enumerate(known) if column in _IMAGES), None)
    numbers, rows = [], []
    for line in lines:
        if line.comment:
            continue
        fields = _fields(line.text, like, len(known))
        if image is not None and _separator(like) == " " and (columns or len(fields) > len(known)):
            fields = _fields(quoted_image(line.text, image), like, len(known))
        while len(fields) > len(known) and not fields[-1]:
            fields.pop()
        if columns is None and len(fields) > len(known):
            raise InputError(
                f"line {line.number} has {len(fields)} fields under {len(known)} columns",
                file=path,
                fix="with decimal commas, separate the fields by semicolons",
            )
        numbers.append(line.number)
        rows.append(fields)
    if not rows:
        raise InputError("the table has a header and no lines", file=path, fix="give a line per item")
    cells = {
        column: [None if i >= len(row) or row[i].lower() in _UNKNOWN else row[i] for row in rows]
        for i, column in enumerate(known)
        if column is not None
    }
    return ParsedTable(path, factors, tuple(unknown), tuple(numbers), cells, frozenset(unstated))
