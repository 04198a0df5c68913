"""Subtitles (SRT) in which drones write where they were, by DJI's formats."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Final

from geomosaic.doors.files import TEXT_BYTES, read_text
from geomosaic.errors import InputError

_BEGIN: Final = re.compile(r"(\d{1,3}):(\d\d):(\d\d)[,.](\d{3})\s*-->")
_NUMBER: Final = r"\s*:?\s*([-+]?\d{1,7}(?:\.\d{1,15})?)"
_NAMED: Final = {
    "lat": re.compile(r"\blatitude" + _NUMBER, re.IGNORECASE),
    "lon": re.compile(r"\blongt?itude" + _NUMBER, re.IGNORECASE),
    "height": re.compile(r"\b(?:abs_alt|altitude)" + _NUMBER, re.IGNORECASE),
    "above": re.compile(r"\brel_alt" + _NUMBER, re.IGNORECASE),
}
_GPS: Final = re.compile(r"\bGPS\s*\(([-+]?\d{1,3}\.\d{1,12}),\s*([-+]?\d{1,2}\.\d{1,12})\b", re.IGNORECASE)
"""Older drones: longitude, latitude, and the number of satellites."""
_FIX: Final = "give the SRT file that the drone wrote, or leave out --srt"


@dataclass(frozen=True)
class VideoPosition:
    """Where the drone was from a moment of the video on, in s: WGS 84; height of an unstated datum and above
    the take-off in m, None where not written."""

    time_s: float
    lon_deg: float
    lat_deg: float
    height_m: float | None
    above_take_off_m: float | None


def read_subtitles(path: Path) -> list[VideoPosition]:
    """The positions, by time.

    Raises: `FileError` for what cannot be read, `InputError` where no subtitle has a position.
    """
    text = read_text(path, TEXT_BYTES, "subtitles", _FIX)
    starts = list(_BEGIN.finditer(text))
    out = []
    for k, start in enumerate(starts):
        words = text[start.end() : starts[k + 1].start() if k + 1 < len(starts) else len(text)]
        hours, minutes, seconds, milliseconds = map(int, start.groups())
        at = timedelta(hours=hours, minutes=minutes, seconds=seconds, milliseconds=milliseconds)
        if (found := _position(at.total_seconds(), words)) is not None:
            out.append(found)
    if not out:
        raise InputError("no subtitle has a latitude and a longitude", file=path, fix=_FIX)
    return sorted(out, key=lambda one: one.time_s)


def _position(time_s: float, words: str) -> VideoPosition | None:
    found = {name: float(m[1]) for name, pattern in _NAMED.items() if (m := pattern.search(words))}
    if (gps := _GPS.search(words)) is not None:
        found |= {"lon": float(gps[1]), "lat": float(gps[2])}
    lon, lat = found.get("lon", 0.0), found.get("lat", 0.0)
    if not (-180.0 <= lon <= 180.0 and -90.0 <= lat <= 90.0) or (lon == 0.0 and lat == 0.0):
        return None  # no fix yet
    return VideoPosition(time_s, lon, lat, found.get("height"), found.get("above"))
