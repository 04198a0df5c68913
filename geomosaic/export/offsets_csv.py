"""offsets.csv: the offsets of every line of every pair, written fast; true ones are read with care."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.ccd.model import LABELS, PairOffsets
from geomosaic.doors.files import read_text
from geomosaic.errors import FileError, InputError, OutputError
from geomosaic.survey.strips import StripGeometry

COLUMNS: Final = ("pair", "line", "dcol_px", "dline_px", "sd_col_px", "sd_line_px", "label")
_TRUTH_COLUMNS: Final = COLUMNS[:4]
_ROWS_AT_ONCE = 4096
_MOST_BYTES_A_ROW = 200
_LARGEST = 1e9
_FIX = "give the offsets.csv of a run of these strips"


def write_offsets_csv(path: Path, pairs: tuple[PairOffsets, ...]) -> None:
    """One row for every line of every pair's left strip; pairs and lines count from 0.

    Four decimals. The caller makes it atomic by giving a temporary path. Raises: `OutputError`.
    """
    try:
        with path.open("w", encoding="ascii", newline="") as file:
            file.write(",".join(COLUMNS) + "\n")
            for pair in pairs:
                file.writelines(_texts(pair))
    except OSError as error:
        raise OutputError(error.strerror or str(error), file=path, fix="free some space") from error


def _texts(pair: PairOffsets) -> Iterator[str]:
    words = np.array(LABELS, dtype=object)[pair.label]
    columns = [pair.dcol_px, pair.dline_px, pair.sd_col_px, pair.sd_line_px]
    row = f"{pair.pair},%d,%.4f,%.4f,%.4f,%.4f,%s\n"
    for start in range(0, len(words), _ROWS_AT_ONCE):
        part = slice(start, start + _ROWS_AT_ONCE)
        # Adding 0 makes -0.0 a 0; rounding first keeps "-0.0000" out.
        values = [np.round(c[part], 4) + 0.0 for c in columns]
        count = len(values[0])
        table = zip(range(start, start + count), *(v.tolist() for v in values), words[part], strict=True)
        yield "".join([row % cells for cells in table])


def read_true_offsets(path: Path, geometry: StripGeometry) -> dict[int, Floats]:
    """Offsets (lines, 2) dcol, dline by pair, of a file that has at least the columns pair to dline_px.

    Raises: `FileError` or `InputError` with one line that names the file and the fix.
    """
    return {pair: rows[:, 2:].copy() for pair, rows in _pairs(path, geometry)}


def _pairs(path: Path, geometry: StripGeometry) -> Iterator[tuple[int, Floats]]:
    """Each pair of the geometry with its rows (lines, 4), in order and whole."""
    table = _table(path, geometry)
    starts = np.flatnonzero(np.diff(table[:, 0], prepend=-1.0))
    wanted = [k for k in geometry.pairs if geometry.lines[k] and geometry.lines[k + 1]]
    if table[starts, 0].tolist() != wanted:
        there = ", ".join(str(k) for k in wanted)
        raise InputError(f"hasn't the pairs of this geometry, which are {there}", file=path, fix=_FIX)
    for pair, rows in zip(wanted, np.split(table, starts[1:]), strict=True):
        lines = geometry.lines[pair]
        if not np.array_equal(rows[:, 1], np.arange(lines)):
            problem = f"hasn't the lines 0 to {lines - 1} of pair {pair}, one row each"
            raise InputError(problem, file=path, fix=_FIX)
        yield pair, rows


def _table(path: Path, geometry: StripGeometry) -> Floats:
    """The columns `_TRUTH_COLUMNS`."""
    most = _MOST_BYTES_A_ROW * (sum(geometry.lines) + 100)
    header, _, rows = read_text(path, most, "offsets of these strips", _FIX).partition("\n")
    names = tuple(name.strip() for name in header.split(","))
    if not set(_TRUTH_COLUMNS) <= set(names) or len(set(names)) < len(names):
        raise FileError(f"hasn't the columns {', '.join(_TRUTH_COLUMNS)}", file=path, fix=_FIX)
    places = [names.index(name) for name in _TRUTH_COLUMNS]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without rows
            table = np.loadtxt(io.StringIO(rows), delimiter=",", comments=None, usecols=places, ndmin=2)
    except ValueError as error:
        problem = "isn't a table of offsets: a row is short or holds no numbers"
        raise FileError(problem, file=path, fix=_FIX) from error
    for name, column in zip(_TRUTH_COLUMNS, table.T, strict=True):
        if not (np.abs(column) <= _LARGEST).all():
            raise FileError(f"has a {name} that is not finite", file=path, fix=_FIX)
    return table
