"""Cameras of one aircraft that take pictures at once: wide and thermal ones as the bands of a rig."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final

from geomosaic.errors import InputError
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.model import UnusedImage
from geomosaic.survey.plausible import NEIGHBOURS
from geomosaic.survey.rig import AT_ONCE_S, BandHeader, CaptureGroups, capture_by_name, capture_by_tag
from geomosaic.survey.strays import BANDS, Stray, camera_kind

_Key = Callable[[FrameHeader], str]
JOINED: Final = "+"
"""Stands between the kinds of cameras that are mosaicked together."""


def captures_of_kinds(headers: Sequence[FrameHeader], kinds: Sequence[str]) -> CaptureGroups:
    """The captures of several of an aircraft's cameras, of which the first carries the rig.

    Files belong together by a capture's tag, else by names that are alike but for the camera's letter
    (`DJI_0001_W.JPG`, `DJI_0001_T.JPG`), else by time.
    Raises: `InputError` where a camera has no file, took none with the first one, or has files of several
    bands.
    """
    if BANDS in kinds:
        raise InputError(
            f"the bands of the camera '{BANDS}' can't be mosaicked with another camera's",
            file=headers[0].path.parent,
            fix="mosaic each camera by itself with --camera-kind",
        )
    files = {kind: [h for h in headers if camera_kind(h) == kind] for kind in kinds}
    for kind, of in files.items():
        if not of:
            there = ", ".join(sorted({camera_kind(h) for h in headers} - {""})) or "none"
            raise InputError(
                f"no frame is of the camera '{kind}' (by the tag ImageSource there are: {there})",
                fix="give --camera-kind one or several of these, such as wide+thermal, or leave it out",
            )
    own = files[kinds[0]]
    others: dict[str, dict[str, BandHeader]] = {}
    lost: list[FrameHeader] = []
    for kind in kinds[1:]:
        found = _together(own, files[kind])
        if not found:
            raise InputError(
                f"no frame of the camera '{kind}' was taken at once with one of '{kinds[0]}'",
                file=files[kind][0].path.parent,
                fix="mosaic each camera by itself with --camera-kind",
            )
        others[kind] = {name: BandHeader(h, name, kind, None, None) for name, h in found.items()}
        paired = {h.name for h in found.values()}
        lost += [h for h in files[kind] if h.name not in paired]
    of_own = tuple(BandHeader(h, h.name, kinds[0], None, None) for h in own)
    return CaptureGroups(of_own, others, tuple(lost))


def other_cameras(headers: Sequence[FrameHeader], kinds: Sequence[str]) -> list[Stray]:
    """Frames of other cameras of the aircraft than these kinds."""
    text = f"is of another camera, the mosaic of {' and '.join(kinds)}"
    others = [h for h in headers if camera_kind(h) not in kinds]
    return [("frame-other-camera", UnusedImage(h.name, text)) for h in others]


def _together(own: Sequence[FrameHeader], other: Sequence[FrameHeader]) -> dict[str, FrameHeader]:
    """The other camera's file of each capture, by the own file's name."""
    found: dict[str, FrameHeader] = {}
    for key in (capture_by_tag, capture_by_name):
        left = _unpaired(own, other, found)
        ours, theirs = (_once(key, of) for of in left)
        found |= {header.name: theirs[of] for of, header in ours.items() if of in theirs}
    return found | _by_time(*_unpaired(own, other, found))


def _unpaired(
    own: Sequence[FrameHeader], other: Sequence[FrameHeader], found: dict[str, FrameHeader]
) -> tuple[list[FrameHeader], list[FrameHeader]]:
    paired = {h.name for h in found.values()}
    return [h for h in own if h.name not in found], [h for h in other if h.name not in paired]


def _once(key: _Key, headers: Sequence[FrameHeader]) -> dict[str, FrameHeader]:
    """Files by their capture, without captures that have several."""
    count = Counter(map(key, headers))
    return {key(h): h for h in headers if key(h) and count[key(h)] == 1}


def _by_time(own: Sequence[FrameHeader], other: Sequence[FrameHeader]) -> dict[str, FrameHeader]:
    """Files that are nearest to each other in time."""
    timed = [(h.exif.time_s, h) for h in own if h.exif.time_s is not None]
    theirs = sorted(
        ((h.exif.time_s, h.name, h) for h in other if h.exif.time_s is not None), key=lambda t: t[:2]
    )
    times = [time_s for time_s, _, _ in theirs]
    near = [
        (abs(times[k] - time_s), k, header)
        for time_s, header in timed
        for k in range(
            max(bisect_left(times, time_s - AT_ONCE_S), bisect_left(times, time_s) - NEIGHBOURS),
            min(bisect_right(times, time_s + AT_ONCE_S), bisect_right(times, time_s) + NEIGHBOURS),
        )
    ]
    found: dict[str, FrameHeader] = {}
    used: set[int] = set()
    for _, k, header in sorted(near, key=lambda one: one[:2]):
        if header.name not in found and k not in used:
            found[header.name] = theirs[k][2]
            used.add(k)
    return found
