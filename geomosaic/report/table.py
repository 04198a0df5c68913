"""A table that people sort, filter, and select on the map: frames of a block, pairs of strips."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from geomosaic.report.numbers import short, whole


@dataclass(frozen=True)
class Cell:
    """What is shown, and what it is sorted by, empty where the text itself is."""

    text: str
    by: str = ""


@dataclass(frozen=True)
class TableRow:
    """kind: what can be chosen by (`tied`); place: its number on the map, in the order of layers' rows."""

    place: int
    kind: str
    cells: Sequence[Cell]


@dataclass(frozen=True)
class ReportTable:
    """noun: of a row. columns: title, and whether it holds numbers. kinds: of the rows, with what each means.
    left_out: rows that are not on the page."""

    noun: str
    columns: Sequence[tuple[str, bool]]
    rows: Sequence[TableRow]
    kinds: Sequence[tuple[str, str]]
    left_out: int = 0
    elsewhere: str = ""


def number(value: float, unit: str = "", digits: int = 3) -> Cell:
    """A figure; sorted below all others where it isn't known."""
    known = math.isfinite(value)
    return Cell(short(value, unit, digits), f"{value:.6g}" if known else "-1e99")


def count(value: int) -> Cell:
    """A whole number."""
    return Cell(whole(value), str(value))
