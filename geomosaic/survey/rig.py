"""Cameras of one rig that write a file a band: the files of one capture belong together."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Final

from geomosaic.constants import sourced
from geomosaic.errors import InputError
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.model import Warn
from geomosaic.survey.names import natural_key, some
from geomosaic.survey.xmp import Xmp, number

AT_ONCE_S = sourced(1.0, "s", "between a capture's times: less loses files; more mixes", "EXIF: whole s")
_CAPTURE_TAGS: Final = (
    "Camera:CaptureUUID",
    "MicaSense:CaptureId",
    "drone-dji:CaptureUUID",  # Phantom 4 Multispectral
    "Camera:ImageUniqueID",  # Sentera
)
_OWN: Final = ("green", "red", "rededge", "red edge")
"""Bands by how much of a field or a town they show with sharp edges: the first there is carries the rig."""
_COPY_BANDS: Final = "copy the missing files from the card"
_SUFFIX: Final = re.compile(r"(.+)_([A-Za-z]{1,4}|\d{1,2})", re.ASCII)
"""`IMG_0001_GRE`, `IMG_0001_4`: the capture's name and the band's."""


@dataclass(frozen=True)
class BandHeader:
    """A file of one band: the capture it belongs to, the band's name, wavelength in nm and number in the rig,
    None where nothing reports it."""

    header: FrameHeader
    capture: str
    band: str
    wavelength_nm: float | None
    index: float | None


@dataclass(frozen=True)
class CaptureGroups:
    """A rig's files, grouped.

    own: one file of each capture, all of the same band, which stands for the capture. others: of each other
    band by name, the files by the own file's name. incomplete: files whose capture has no own one, copies,
    and those without the tags that most have.
    """

    own: tuple[BandHeader, ...]
    others: dict[str, dict[str, BandHeader]]
    incomplete: tuple[FrameHeader, ...]


def captures(headers: Sequence[FrameHeader]) -> CaptureGroups | None:
    """The captures of a rig, None where the files are not a rig's.

    Tags decide (`CaptureUUID` or `CaptureId` with `BandName`); without them names that end alike in all
    captures (`_GRE`, `_4`). Only files of one band can be a rig's.

    Raises: `InputError` where files of several bands belong to no captures: one mosaic would mix them.
    """
    if any(h.bands != 1 for h in headers):
        return None
    files = _files(headers)
    if not files:
        _check_one_band(headers)
        return None
    own_band = min(Counter(f.band for f in files).items(), key=lambda item: _rank(item[0], item[1], files))[0]
    own = {f.capture: f for f in files if f.band == own_band}
    others: dict[str, dict[str, BandHeader]] = {}
    for file in sorted(files, key=lambda f: (f.wavelength_nm or 0.0, f.index or 0.0, natural_key(f.band))):
        if file.band != own_band and file.capture in own:
            others.setdefault(file.band, {})[own[file.capture].header.name] = file
    used = {f.header.name for f in files if f.capture in own}
    lost = tuple(h for h in headers if h.name not in used)
    return CaptureGroups(tuple(own.values()), others, lost)


def captured_files(headers: Sequence[FrameHeader]) -> list[list[str]]:
    """The names of the files of each capture, in the headers' order: as `captures` finds them, else by tags
    of captures alone, and without these a file each."""
    of = {f.header.name: f.capture for f in _files(headers)}
    found: dict[str, list[str]] = {}
    for header in headers:
        capture = of.get(header.name) or capture_by_tag(header) or header.name
        found.setdefault(capture, []).append(header.name)
    return list(found.values())


def incomplete_captures(rig: CaptureGroups, used: Sequence[str]) -> list[Warn]:
    """Captures that lack a file. Args: used: names of the captures' own files that the survey has."""
    out = []
    if lost := rig.incomplete:
        out.append(
            f"{len(lost)} files are not used, copies, or of captures without tags or the rig's first band: "
            f"{some(h.name for h in lost)}; {_COPY_BANDS}"
        )
    for band, files in rig.others.items():
        if lacking := [name for name in used if name not in files]:
            out.append(
                f"no file of the band {band} for {some(lacking)}: other captures show that ground; "
                f"{_COPY_BANDS}"
            )
    return [Warn("capture-incomplete", "", text) for text in out]


def _files(headers: Sequence[FrameHeader]) -> list[BandHeader]:
    """A rig's files with their bands and captures, none where they are not a rig's. Without those that lack
    tags which most have, and without copies."""
    tagged = [f for f in map(_by_tags, headers) if f is not None]
    if 2 * len(tagged) > len(headers):
        once = {(f.capture, f.band): f for f in reversed(tagged)}  # the first, of copies
        files = [f for f in tagged if once[f.capture, f.band] is f]
        return files if _grouped(files) else []
    files = [f for f in map(_by_name, headers) if f is not None]
    return files if len(files) == len(headers) and _grouped(files) and _at_once(files) else []


def _check_one_band(headers: Sequence[FrameHeader]) -> None:
    by_band: dict[str, FrameHeader] = {}
    for header in headers:
        by_band.setdefault((header.xmp or {}).get("Camera:BandName", ""), header)
    if len(by_band) > 1:
        names = ", ".join(sorted(band or "none" for band in by_band))
        raise InputError(
            f"the files show different bands ({names}), and no tag says which were taken at once",
            file=next(iter(by_band.values())).path.parent,
            fix="put the files of each band into a folder of their own",
        )


def _grouped(files: Sequence[BandHeader]) -> bool:
    """Whether captures hold several bands, each once, and bands several captures or all files one."""
    bands = Counter(f.band for f in files)
    each = Counter((f.capture, f.band) for f in files)
    several = Counter(f.capture for f in files).most_common(1)[0][1] > 1
    return len(bands) > 1 and several and max(each.values()) == 1


def _at_once(files: Sequence[BandHeader]) -> bool:
    """Whether files that names group were taken at once: by their times, else by there being more captures
    than bands, since numbers that count on look alike."""
    times: dict[str, list[float]] = {}
    for file in files:
        if file.header.exif.time_s is not None:
            times.setdefault(file.capture, []).append(file.header.exif.time_s)
    if times:
        return all(max(its) - min(its) <= AT_ONCE_S for its in times.values())
    return len({f.capture for f in files}) > len({f.band for f in files})


def _rank(band: str, count: int, files: Sequence[BandHeader]) -> tuple[float, float, float, str]:
    """Bands that most captures have come first, then the usual ones, then by number."""
    first = next(f for f in files if f.band == band)
    known = _OWN.index(band.lower()) if band.lower() in _OWN else len(_OWN)
    return -count, known, first.index if first.index is not None else 99.0, band


def capture_by_tag(header: FrameHeader) -> str:
    """The capture that a file's tags name, '' where they name none."""
    xmp: Xmp = header.xmp or {}
    return next((xmp[name] for name in _CAPTURE_TAGS if xmp.get(name)), "")


def capture_by_name(header: FrameHeader) -> str:
    """A file's name without a band's or a camera's letters at its end, '' where it has none."""
    match = _SUFFIX.fullmatch(PurePath(header.name).stem)
    return "" if match is None else match[1]


def _by_tags(header: FrameHeader) -> BandHeader | None:
    xmp: Xmp = header.xmp or {}
    capture = capture_by_tag(header)
    band = xmp.get("Camera:BandName") or xmp.get("drone-dji:BandName", "")
    if not capture or not band or "," in band:
        return None
    index = number(xmp, "Camera:RigCameraIndex")
    wavelength_nm = number(xmp, "Camera:CentralWavelength", "drone-dji:CentralWavelength")
    return BandHeader(header, capture, band, wavelength_nm, index)


def _by_name(header: FrameHeader) -> BandHeader | None:
    match = _SUFFIX.fullmatch(PurePath(header.name).stem)
    if match is None:
        return None
    index = float(match[2]) if match[2].isdigit() else None
    return BandHeader(header, match[1], match[2].upper() if index is None else match[2], None, index)
