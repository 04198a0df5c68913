"""Frames of a video: as many as overlap by a share, each the sharpest about its place."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from geomosaic.arrays import Bytes
from geomosaic.constants import tuned
from geomosaic.errors import FileError, InputError
from geomosaic.video.container import require_video
from geomosaic.video.motion import VideoLook, chosen_looks
from geomosaic.video.subtitles import VideoPosition

_LOOKS_PER_S = tuned(6.0, "looks/s", "fewer miss fast drones' overlap; more only take time")
_LOOK_PX = tuned(320, "px", "longer side of a look: sharpness and motion to a hundredth of the frame show")
_REACH_S = tuned(2.0, "s", "from a written position: more outlasts a loss of GNSS; less needs many a second")
_END = tuned(0.5, "of the time between positions", "beyond an end: the error stays below half their distance")
_QUALITY: Final = 95
POSITIONS: Final = "pos.csv"
Report = Callable[[int, int, str], None]
"""Called with how much is done, of how much, and of what."""


@dataclass(frozen=True)
class VideoOptions:
    """overlap: share of a frame that the next one shows again. positions: where the drone was, by time."""

    overlap: float = 0.75
    positions: Sequence[VideoPosition] = ()


def extract_frames(video: Path, folder: Path, options: VideoOptions, report: Report) -> list[str]:
    """Writes frames as JPEG into the folder, and their positions to pos.csv; returns the frames' names.

    A frame is due once the image has moved on by what the overlap leaves since the last one. Of the frames
    about that moment the sharpest is taken. Standing still gives none.

    A frame has the position between those written before and after it, if one of them is at most `_REACH_S`
    away. Before the first and after the last one it has that position for half of the usual interval.

    Raises: `FileError` for what is no video, `InputError` where no two frames can be chosen, or no frame has
    any of the positions.
    """
    chosen = {look.number: look.time_s for look in chosen_looks(_looks(video, report), 1.0 - options.overlap)}
    if len(chosen) < 2:
        raise InputError(
            "the picture does not move on", file=video, fix="give a video of a flight over ground"
        )
    names = {}
    for number, image in _decoded(video, report, chosen):
        names[number] = f"{video.stem}_{number:06d}.jpg"
        ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        if not ok:
            raise FileError("a frame cannot be written as JPEG", file=video, fix="convert the video to MP4")
        (folder / names[number]).write_bytes(data.tobytes())
    if options.positions:
        places = {n: _at(options.positions, chosen[n]) for n in sorted(names)}
        rows = [(names[n], place) for n, place in places.items() if place is not None]
        if not rows:
            fix = "give the SRT file of this video with --srt"
            raise InputError("no frame was taken while positions were written", file=video, fix=fix)
        _write_positions(folder / POSITIONS, rows)
    return [names[n] for n in sorted(names)]


def _opened(video: Path) -> Any:
    require_video(video)
    # FFmpeg takes `12:30.mp4` for a protocol, and `/folder/12:30.mp4` for a file.
    reader = cv2.VideoCapture(str(video.absolute()), cv2.CAP_FFMPEG)
    if not reader.isOpened():
        raise FileError("is no video that can be read", file=video, fix="give an MP4 or MOV file")
    return reader


def _decoded(video: Path, report: Report, wanted: Mapping[int, float]) -> Iterator[tuple[int, Bytes]]:
    """The frames of these numbers, in their order."""
    reader, last = _opened(video), max(wanted)
    for number in range(last + 1):
        if not reader.grab():
            return
        if number in wanted:
            good, image = reader.retrieve()
            if good:
                yield number, image
            report(number, last, "frames of the video")


def _looks(video: Path, report: Report) -> Iterator[VideoLook]:
    """Some frames a second at reduced size."""
    reader = _opened(video)
    rate = reader.get(cv2.CAP_PROP_FPS)
    rate = rate if 1.0 <= rate <= 1000.0 else 30.0
    step, total = max(round(rate / _LOOKS_PER_S), 1), int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    number, time_s = 0, 0.0
    while reader.grab():
        # The time that the file states: phones and some drones do not keep their rate.
        stated_s = reader.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        time_s = stated_s if stated_s > time_s or number == 0 else time_s + 1.0 / rate
        if number % step == 0:
            good, image = reader.retrieve()
            if good:
                yield _look(number, time_s, image)
            report(number, max(total, number + 1), "motion in the video")
        number += 1


def _look(number: int, time_s: float, image: Bytes) -> VideoLook:
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    scale = min(_LOOK_PX / max(grey.shape), 1.0)
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.float32)
    return VideoLook(number, time_s, small, float(cv2.Laplacian(grey, cv2.CV_32F).var()))


def _at(positions: Sequence[VideoPosition], time_s: float) -> VideoPosition | None:
    """Between the last one written before and the next; None where neither is near."""
    times = np.array([one.time_s for one in positions])
    k = int(np.searchsorted(times, time_s, side="right"))
    near = positions[max(k - 1, 0) : k + 1]
    reach_s = _REACH_S
    if len(near) == 1:
        apart_s = np.diff(np.unique(times))
        reach_s = min(_END * float(np.median(apart_s)), _REACH_S) if len(apart_s) else 0.0
    if min(abs(one.time_s - time_s) for one in near) > reach_s:
        return None
    first, last = near[0], near[-1]
    span_s = last.time_s - first.time_s
    share = (time_s - first.time_s) / span_s if span_s > 0.0 else 0.0

    def between(a: float | None, b: float | None) -> float | None:
        return None if a is None or b is None else a + share * (b - a)

    east_deg = (last.lon_deg - first.lon_deg + 180.0) % 360.0 - 180.0
    return VideoPosition(
        time_s,
        (first.lon_deg + share * east_deg + 180.0) % 360.0 - 180.0,
        first.lat_deg + share * (last.lat_deg - first.lat_deg),
        between(first.height_m, last.height_m),
        between(first.above_take_off_m, last.above_take_off_m),
    )


def _write_positions(path: Path, rows: Sequence[tuple[str, VideoPosition]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(["frame", "lon_deg", "lat_deg", "altitude_m", "relative_altitude_m"])
        for name, at in rows:
            heights = ("" if h is None else f"{h:.3f}" for h in (at.height_m, at.above_take_off_m))
            table.writerow([name, f"{at.lon_deg:.8f}", f"{at.lat_deg:.8f}", *heights])
