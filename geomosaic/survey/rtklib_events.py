"""RTKLIB's events (`*_events.pos`) of RTKPOST and Emlid Studio: the camera's place at each exposure.

Lines of comments begin with `%`; the last of them names the columns: `% GPST latitude(deg) longitude(deg)
height(m) Q ns sdn(m) sde(m) sdu(m) ...`. Q is 1 for a solution with fixed ambiguities, 2 for a float one
(RTKLIB 2.4.2 manual, appendix B.1).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from geomosaic.errors import InputError
from geomosaic.survey.names import FrameNames
from geomosaic.survey.pos_row import PosFile, PosRow
from geomosaic.survey.table import Line, read_lines
from geomosaic.survey.timestamp_mrk import exposure_row

_NAMED: Final = ("latitude(deg)", "longitude(deg)", "height(m)", "Q", "sde(m)", "sdn(m)", "sdu(m)")
_QUALITY: Final = {1: "rtk-fixed", 2: "rtk-float"}
_FIX: Final = "write the solution again as latitude, longitude and height in degrees and metres"


def is_rtklib_events(path: Path) -> bool:
    """By its name and its first line."""
    if path.suffix.lower() != ".pos" or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(1) == b"%"


def read_rtklib_events(path: Path, frames: FrameNames) -> PosFile:
    """A row for each frame: the n-th event is the n-th capture's in order (`FrameNames.exposed`).

    Raises: `InputError` naming the file, the line and the fix.
    """
    lines = read_lines(path, "events")
    comments = [line for line in lines if line.text.startswith("%")]
    columns = _columns(path, comments)
    rows = [_row(path, line, columns) for line in lines if line.text and not line.text.startswith("%")]
    exposed = frames.exposed(len(rows))
    if exposed is None:
        raise InputError(
            f"has {len(rows)} events, and there are {len(frames.all)} frames",
            file=path,
            fix="give the flight's frames alone, or put their names into a table with the events' places",
        )
    above_sea = any("geodetic" in line.text.lower() for line in comments if "out height" in line.text)
    pairs = zip(rows, exposed, strict=True)
    found = tuple(replace(row, name=name) for row, names in pairs for name in names)
    return PosFile(path, found, (), datum_stated=not above_sea)


def _columns(path: Path, comments: Sequence[Line]) -> dict[str, int]:
    """Where each column stands among a line's words; the time takes two of them."""
    for line in reversed(comments):
        words = line.text.lstrip("% ").split()
        if all(name in words for name in _NAMED[:3]):
            return {name: words.index(name) + 1 for name in _NAMED if name in words}
    raise InputError("names no latitude(deg), longitude(deg) and height(m)", file=path, fix=_FIX)


def _row(path: Path, line: Line, columns: dict[str, int]) -> PosRow:
    words = line.text.split()
    try:
        lat, lon, height, quality, east, north, up = (
            float(words[columns[name]]) if name in columns else 0.0 for name in _NAMED
        )
    except (ValueError, IndexError) as error:
        raise InputError(f"line {line.number} is no event", file=path, fix=_FIX) from error
    known = math.isfinite(height) and math.isfinite(quality) and (lat or lon)
    if not (known and abs(lat) <= 90.0 and abs(lon) <= 180.0):
        raise InputError(
            f"line {line.number}: {lat:g}, {lon:g}, {height:g} m is no place", file=path, fix=_FIX
        )
    return exposure_row(line.number, (lon, lat, height), (east, north, up), _QUALITY.get(int(quality)))
