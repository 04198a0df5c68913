"""DJI's `*_Timestamp.MRK`: where the camera was at each exposure, by RTK or to be replaced by PPK.

A line is an exposure: its number, the GPS second and week, and the offsets of the camera from the antenna in
mm (already applied). Then come latitude, longitude and ellipsoidal height of the camera, and their standard
deviations north, east and up in m. Last comes the quality of the fix (DJI, Phantom 4 RTK User Manual,
appendix).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Final

from geomosaic.errors import GeomosaicError, InputError
from geomosaic.survey.accuracy import POSITION, RTK_SD_FLOOR_M
from geomosaic.survey.model import Warn
from geomosaic.survey.names import FrameNames
from geomosaic.survey.onboard import rtk_source
from geomosaic.survey.pos_row import PosFile, PosRow
from geomosaic.survey.table import Line, read_lines

_WORD: Final = re.compile(r"[^\s,\[\]]+")
_FIX: Final = "give the file as the drone wrote it, or positions as a table with a header"


def is_timestamp_mrk(path: Path) -> bool:
    """By its name."""
    return path.suffix.lower() == ".mrk"


def read_timestamp_mrk(path: Path, frames: FrameNames) -> PosFile:
    """A row for each frame of an exposure with a fix.

    Exposures are found by the numbers in the frames' names (`DJI_20230814123501_0007_V.JPG`,
    `100_0001_0007.JPG`), else by order of capture where there are as many frames as exposures.

    Raises: `InputError` naming the file, the line and the fix.
    """
    lines = [line for line in read_lines(path, "exposures") if not line.comment]
    exposures = [_exposure(path, line) for line in lines]
    named = _frames_of([number for number, _ in exposures], frames)
    if named is None:
        raise InputError(
            f"has {len(exposures)} exposures, and the names of {len(frames.all)} frames don't match them",
            file=path,
            fix="give its flight's frames alone under the drone's names, or take the file out of the folder",
        )
    pairs = [(row, name) for (_, row), names in zip(exposures, named, strict=True) for name in names]
    rows = tuple(replace(row, name=name) for row, name in pairs if row is not None)
    without = sum(row is None for _, row in exposures)
    text = f"{path.name}: {without} exposures have no fix; their frames keep their own tags' positions: "
    text += "nothing to do"
    return PosFile(path, rows, (Warn("pos-no-fix", "", text),) if without else ())


def matches(path: Path, frames: FrameNames) -> bool:
    """Whether it can be read, and its exposures are these frames."""
    with suppress(GeomosaicError):
        return bool(read_timestamp_mrk(path, frames).rows)
    return False


def _exposure(path: Path, line: Line) -> tuple[int, PosRow | None]:
    """Its number, and a row without a name; None without a fix."""
    words = _WORD.findall(line.text)
    try:
        number = int(words[0])
        lat_deg, lon_deg, height_m = (float(words[words.index(name) - 1]) for name in ("Lat", "Lon", "Ellh"))
        end = words.index("Ellh") + 1
        north, east, up = (float(word) for word in words[end : end + 3])
        fix = int(words[words.index("Q") - 1]) if "Q" in words else 50
    except (ValueError, IndexError) as error:
        raise InputError(
            f"line {line.number} is no exposure of a Timestamp.MRK", file=path, fix=_FIX
        ) from error
    if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0 and math.isfinite(height_m)):
        problem = f"line {line.number}: {lat_deg:g}, {lon_deg:g}, {height_m:g} m is no place"
        raise InputError(problem, file=path, fix=_FIX)
    if fix == 0 or (lat_deg == 0.0 and lon_deg == 0.0):
        return number, None
    place = (lon_deg, lat_deg, height_m)
    return number, exposure_row(line.number, place, (east, north, up), rtk_source(fix))


def exposure_row(
    line: int, place: tuple[float, float, float], stated_m: Sequence[float], quality: str | None
) -> PosRow:
    """A row without a name. place: longitude, latitude, ellipsoidal height; stated_m: deviations east, north
    and up, 0 where not stated; quality: of the fix, a source of `accuracy.POSITION`."""
    default = POSITION[quality or "exif"]
    usual = (default.sd_horizontal_m, default.sd_horizontal_m, default.sd_vertical_m)
    least = (RTK_SD_FLOOR_M[0], *RTK_SD_FLOOR_M) if quality == "rtk-fixed" else usual
    sd_east, sd_north, sd_up = (
        max(sd, floor) if 0.0 < sd < math.inf else other
        for sd, floor, other in zip(stated_m, least, usual, strict=True)
    )
    return PosRow("", line, *place, sd_east_m=sd_east, sd_north_m=sd_north, sd_vertical_m=sd_up)


def _frames_of(numbers: Sequence[int], frames: FrameNames) -> Sequence[Sequence[str]] | None:
    """The frames of each exposure; None where neither names nor order tell. The number is the last in the
    names, or one before it where that is in several."""
    names = frames.in_order
    parts = {name: re.findall(r"(\d+)(\D*)", PurePath(name).stem) or [("-1", name)] for name in names}
    for place in range(-1, -min(map(len, parts.values()), default=0) - 1, -1):
        by_number: dict[int, dict[str, str]] = {}
        for name, its in parts.items():
            by_number.setdefault(int(its[place][0]), {})["".join(sum(its[place:], ())[1:])] = name
        found = [[*by_number.get(number, {}).values()] for number in numbers]
        if sum(map(len, found)) == len(names):
            return found
        if place == -1 and sum(map(len, by_number.values())) == len(names):
            return frames.exposed(len(numbers))
    return None
