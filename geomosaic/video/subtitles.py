"""Subtitles with a drone's positions, by DJI's formats: an SRT file, or a track of the video."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from fractions import Fraction
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
_CONTAINER_S: Final = Fraction(1, 1_000_000)
"""Unit of a container's times: AV_TIME_BASE of FFmpeg."""
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


def read_subtitles(path: Path, delay_s: float = 0.0) -> list[VideoPosition]:
    """The positions, by time from the first image of the video on.

    Args: delay_s: of that image after the video's begin, from which subtitles count; see `image_delay_s`.
    Raises: `FileError` for what cannot be read or contains no subtitles, `InputError` where no subtitle has a
    position.
    """
    text = read_text(path, TEXT_BYTES, "subtitles", _FIX)
    starts = list(_BEGIN.finditer(text))
    if not starts:
        raise FileError("contains no subtitles", file=path, fix=_FIX)
    ends = [*(start.start() for start in starts[1:]), len(text)]
    out = _positions(
        (_time_s(start) - delay_s, text[start.end() : end]) for start, end in zip(starts, ends, strict=True)
    )
    if not out:
        raise InputError("no subtitle has a latitude and a longitude", file=path, fix=_FIX)
    return out


def tracks_readable() -> bool:
    """Whether the extra `video` is installed."""
    return find_spec("av") is not None


def read_subtitle_tracks(video: Path) -> list[VideoPosition]:
    """The positions, by time from the first image on, in the first subtitle track that has some; [] without.

    Raises: `FileError` for what is no video.
    """
    with _opened(video) as file:
        start_s = _start_s(file) or 0.0
        tracks: dict[int, list[VideoPosition]] = {}
        for track, time_s, words in _texts(file):
            if (one := _position(time_s - start_s, words)) is not None:
                tracks.setdefault(track, []).append(one)
    return sorted(tracks[min(tracks)], key=lambda one: one.time_s) if tracks else []


def image_delay_s(video: Path) -> float:
    """How much later than the video itself its images begin; 0 where that is unknown, or without `video`."""
    if not tracks_readable():
        return 0.0
    try:
        with _opened(video) as file:
            start_s = _start_s(file)
            if start_s is None or file.start_time is None:
                return 0.0
            return start_s - float(file.start_time * _CONTAINER_S)
    except FileError:
        return 0.0


@contextmanager
def _opened(video: Path) -> Iterator[Any]:
    import av

    require_video(video)
    try:
        # FFmpeg takes `12:30.mp4` for a protocol, and `/folder/12:30.mp4` for a file.
        with av.open(str(video.absolute())) as file:
            yield file
    except (av.FFmpegError, ValueError, MemoryError) as error:
        raise FileError("is no video that can be read", file=video, fix="give an MP4 or MOV file") from error


def _start_s(file: Any) -> float | None:
    """The time of the first image, from which OpenCV counts; None where the video does not state it."""
    images = next(iter(file.streams.video), None)
    if images is None or images.start_time is None:
        return None
    return float(images.start_time * images.time_base)


def _texts(file: Any) -> Iterator[tuple[int, float, str]]:
    """Track, begin in s and text of the subtitles, without tracks that FFmpeg has no decoder for."""
    tracks = [track for track in file.streams.subtitles if track.codec_context is not None]
    read = 0
    for packet in file.demux(tracks) if tracks else ():
        read += packet.size
        if packet.pts is None or read > TEXT_BYTES:
            continue
        data = bytes(packet)
        data = data[_TRACK_HEAD:] if packet.stream.codec_context.name == "mov_text" else data
        yield packet.stream.index, float(packet.pts * packet.time_base), data.decode("utf-8", "replace")


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
