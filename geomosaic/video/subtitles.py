"""Subtitles with a drone's positions, by DJI's formats: an SRT file, or a track of the video."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from geomosaic.doors.files import TEXT_BYTES, read_text
from geomosaic.errors import FileError, InputError
from geomosaic.video.container import require_video

_BEGIN: Final = re.compile(r"(\d{1,3}):(\d\d):(\d\d)[,.](\d{3})\s*-->")
_FIGURE: Final = r"([-+]?\d{1,7}(?:[.,]\d{1,15})?)"
"""With a point or, by the language of some controllers, a comma."""
_NUMBER: Final = r"\s*:?\s*" + _FIGURE
_NAMED: Final = {
    "lat": re.compile(r"\blatitude" + _NUMBER, re.IGNORECASE),
    "lon": re.compile(r"\blongt?itude" + _NUMBER, re.IGNORECASE),
    "height": re.compile(r"\b(?:abs_alt|altitude)" + _NUMBER, re.IGNORECASE),
    "above": re.compile(rf"\b(?:rel_alt{_NUMBER}|BAROMETER{_NUMBER}|H\s+{_FIGURE}\s*m\b)", re.IGNORECASE),
}
_GPS: Final = re.compile(
    r"\bGPS\s*\(([-+]?\d{1,3}\.\d{1,12}),\s*([-+]?\d{1,3}\.\d{1,12}),\s*[-+]?\d{1,6}(?:\.\d{1,6})?\s*(M?)\)",
    re.IGNORECASE,
)
"""Older drones: longitude, latitude, number of satellites. Where the third is a height in metres, latitude
stands first (Matrice 300)."""
_TRACK_HEAD: Final = 2
"""Bytes of a text's length before it: 3GPP TS 26.245 (timed text), section 5.17."""
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
    ends = [*(start.start() for start in starts[1:]), len(text)]
    out = _positions(
        (_time_s(start), text[start.end() : end]) for start, end in zip(starts, ends, strict=True)
    )
    if not out:
        raise InputError("no subtitle has a latitude and a longitude", file=path, fix=_FIX)
    return out


def tracks_readable() -> bool:
    """Whether the extra `video` is installed."""
    return find_spec("av") is not None


def read_subtitle_tracks(video: Path) -> list[VideoPosition]:
    """The positions, by time, in the first subtitle track of a video that has some; [] without one.

    Raises: `FileError` for what is no video.
    """
    import av

    require_video(video)
    try:
        with av.open(str(video)) as file:
            for track in range(len(file.streams.subtitles)):
                file.seek(0)
                if found := _positions(_texts(file.demux(file.streams.subtitles[track]))):
                    return found
    except (av.FFmpegError, ValueError, MemoryError) as error:
        raise FileError("is no video that can be read", file=video, fix="give an MP4 or MOV file") from error
    return []


def _texts(packets: Iterable[Any]) -> Iterator[tuple[float, str]]:
    """Begin in s and text of a track's packets."""
    read = 0
    for packet in packets:
        read += packet.size
        if packet.pts is None or read > TEXT_BYTES:
            continue
        data = bytes(packet)
        data = data[_TRACK_HEAD:] if packet.stream.codec_context.name == "mov_text" else data
        yield float(packet.pts * packet.time_base), data.decode("utf-8", "replace")


def _time_s(start: re.Match[str]) -> float:
    hours, minutes, seconds, milliseconds = map(int, start.groups())
    at = timedelta(hours=hours, minutes=minutes, seconds=seconds, milliseconds=milliseconds)
    return at.total_seconds()


def _positions(texts: Iterable[tuple[float, str]]) -> list[VideoPosition]:
    found = (_position(time_s, words) for time_s, words in texts)
    return sorted((one for one in found if one is not None), key=lambda one: one.time_s)


def _position(time_s: float, words: str) -> VideoPosition | None:
    matches = {name: m for name, pattern in _NAMED.items() if (m := pattern.search(words))}
    found = {name: float(next(filter(None, m.groups())).replace(",", ".")) for name, m in matches.items()}
    if (gps := _GPS.search(words)) is not None:
        first, second = float(gps[1]), float(gps[2])
        found["lon"], found["lat"] = (second, first) if gps[3] else (first, second)
    if not {"lon", "lat"} <= found.keys():
        return None
    lon, lat = found["lon"], found["lat"]
    if not (-180.0 <= lon <= 180.0 and -90.0 <= lat <= 90.0) or (lon == 0.0 and lat == 0.0):
        return None  # no fix yet
    return VideoPosition(time_s, lon, lat, found.get("height"), found.get("above"))
