"""offsets.csv: the offsets of every line of every pair, written fast and read with care."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from geomosaic.ccd.model import LABELS, Floats, PairOffsets
from geomosaic.doors.files import read_text
from geomosaic.errors import FileError, InputError, OutputError
from geomosaic.survey.strips import StripGeometry

COLUMNS: Final = ("pair", "line", "dcol_px", "dline_px", "sd_col_px", "sd_line_px", "label")
_TRUTH_COLUMNS = COLUMNS[:4]
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


def read_offsets_csv(path: Path, geometry: StripGeometry) -> tuple[PairOffsets, ...]:
    """The offsets in a stranger's offsets.csv, which must fit the geometry.

    Raises: `FileError` or `InputError` with one line that names the file and the fix.
    """
    found = []
    for pair, rows in _pairs(path, geometry, COLUMNS):
        sd = np.stack([rows["sd_col_px"], rows["sd_line_px"]])
        if (sd < 0.0).any():
            raise FileError("has a negative standard deviation", file=path, fix=_FIX)
        label = np.full(len(rows), len(LABELS), dtype=np.uint8)
        for k, word in enumerate(LABELS):
            label[rows["label"] == word] = k
        if (label == len(LABELS)).any():
            line = int(np.argmax(label == len(LABELS)))
            problem = f"the label of pair {pair}, line {line} is none of {', '.join(LABELS)}"
            raise FileError(problem, file=path, fix=_FIX)
        found.append(PairOffsets(pair, rows["dcol_px"].copy(), rows["dline_px"].copy(), sd[0], sd[1], label))
    return tuple(found)


def read_true_offsets(path: Path, geometry: StripGeometry) -> dict[int, Floats]:
    """Offsets (lines, 2) dcol, dline by pair, of a file that has at least the columns pair to dline_px.

    Raises: `FileError` or `InputError` with one line that names the file and the fix.
    """
    return {
        pair: np.stack([rows["dcol_px"], rows["dline_px"]], axis=1)
        for pair, rows in _pairs(path, geometry, _TRUTH_COLUMNS)
    }


def _pairs(
    path: Path, geometry: StripGeometry, columns: tuple[str, ...]
) -> Iterator[tuple[int, NDArray[Any]]]:
    """Each pair of the geometry with its rows, in order and whole."""
    table = _table(path, geometry, columns)
    starts = np.flatnonzero(np.diff(table["pair"], prepend=-1.0))
    wanted = [k for k in geometry.pairs if geometry.lines[k] and geometry.lines[k + 1]]
    if table["pair"][starts].tolist() != wanted:
        there = ", ".join(str(k) for k in wanted)
        raise InputError(f"hasn't the pairs of this geometry, which are {there}", file=path, fix=_FIX)
    for pair, rows in zip(wanted, np.split(table, starts[1:]), strict=True):
        lines = geometry.lines[pair]
        if len(rows) != lines or not np.array_equal(rows["line"], np.arange(lines)):
            problem = f"hasn't the lines 0 to {lines - 1} of pair {pair}, one row each"
            raise InputError(problem, file=path, fix=_FIX)
        yield pair, rows


def _table(path: Path, geometry: StripGeometry, columns: tuple[str, ...]) -> NDArray[Any]:
    most = _MOST_BYTES_A_ROW * (sum(geometry.lines) + 100)
    header, _, rows = read_text(path, most, "offsets of these strips", _FIX).partition("\n")
    names = tuple(name.strip() for name in header.split(","))
    if not set(columns) <= set(names) or len(set(names)) < len(names):
        raise FileError(f"hasn't the columns {', '.join(columns)}", file=path, fix=_FIX)
    kinds = [("label", "U12") if name == "label" else (name, np.float64) for name in columns]
    places = [names.index(name) for name in columns]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without rows
            file = io.StringIO(rows)
            table = np.loadtxt(file, kinds, delimiter=",", comments=None, usecols=places, ndmin=1)
    except ValueError as error:
        problem = "isn't a table of offsets: a row is short or holds no numbers"
        raise FileError(problem, file=path, fix=_FIX) from error
    for name in columns:
        if name != "label" and not (np.abs(table[name]) <= _LARGEST).all():
            raise FileError(f"has a {name} that is not finite", file=path, fix=_FIX)
    return table
