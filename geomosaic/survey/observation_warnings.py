"""What is assumed or doubtful about the positions and attitudes of frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from geomosaic.survey.extent import away_m
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.model import Attitude, Position, Warn
from geomosaic.survey.names import some
from geomosaic.survey.onboard import onboard_heights
from geomosaic.survey.tagged_place import APART, FINER, SIGNED, TaggedPlace, tagged_place

_TEXTS: Final = {
    "position-missing": "no position: placed by the images; give it with --pos if its ground is missing",
    "height-datum-unknown": "the altitude's vertical datum is unknown, taken as ellipsoidal with its wide "
    "sigma; give --height-datum if you know it",
    "height-unknown": "no height at all: estimated from other frames and the images; give heights with --pos",
    "height-above-take-off": "height above the take-off point taken as height above ground: nothing to do "
    "over flat land, over hills give --dem, and ellipsoidal heights with --pos",
    "hemisphere-assumed": "EXIF doesn't say north or south, east or west: taken as north and east; "
    "if the map lies wrong, give --pos",
    "hemisphere-by-xmp": "EXIF and XMP differ in north or south, east or west: XMP's signs are taken; if the "
    "map lies wrong, give --pos",
    "position-by-xmp": "EXIF's position is rounded to coarser parts of a degree than XMP's, which is taken",
    "position-contradicts": "EXIF and XMP give different positions: EXIF's is taken; if the map lies wrong, "
    "give positions by --pos",
    "xmp-unreadable": "the XMP packet is damaged and was not used: heights and attitude in it are lost; copy "
    "the frame again from the card",
    "attitude-unknown": "no attitude: taken to look down, and the images find the heading; nothing to do if "
    "the camera looked down, else give attitudes with --pos",
    "attitude-in-part": "only part of the attitude is known; the rest is taken as looking down: nothing to "
    "do if the camera did, else give attitudes with --pos",
    "attitude-of-aircraft": "only the aircraft's attitude is known, pitch and roll are not the "
    "camera's: nothing to do if it looked down, else give attitudes with --pos",
    "frame-looks-to-horizon": "the camera looks to the horizon or up: only ground that it sees steeply is "
    "mapped; nothing to do, or take it out of the folder",
    "image-edited": "saved by an image viewer after the flight: may have been turned; "
    "give the file as the camera wrote it",
    "positions-all-alike": "all frames have the same position: only their overlaps show how they lie to each "
    "other; give positions with --pos",
    "position-far-away": "the position lies far from all others: correct it with --pos, or take the frame "
    "out of the folder",
}
"""What each warning says, in their order."""


def observation_warnings(
    headers: Sequence[FrameHeader], positions: Sequence[Position], attitudes: Sequence[Attitude]
) -> list[Warn]:
    """What is assumed or doubtful, once each for all frames it concerns."""
    places = {(p.lon_deg, p.lat_deg) for p in positions if p.known}
    known = np.array([p.known for p in positions])
    alike = len(places) == 1 and int(known.sum()) > 1
    away = away_m(positions)
    far = away > np.maximum(5000.0, 20.0 * np.median(away[known] if known.any() else away))
    concerned: dict[str, list[str]] = {code: [] for code in _TEXTS}
    for header, p, a, is_far in zip(headers, positions, attitudes, far, strict=True):
        xmp, by_tags = header.xmp or {}, p.source != "pos"
        heights = onboard_heights(header.exif, xmp)
        tagged = (tagged_place(header.exif, xmp) if by_tags else None) or TaggedPlace(np.nan, np.nan)
        own_height = by_tags and p.height_ellipsoidal_m == heights.height_m
        own_above = p.height_above_ground_m == heights.above_ground_m
        cases = {
            "position-missing": not p.known,
            "height-datum-unknown": heights.datum_unknown and own_height,
            "height-unknown": p.known and p.height_ellipsoidal_m is None and p.height_above_ground_m is None,
            "height-above-take-off": heights.above_take_off and own_above,
            "hemisphere-assumed": tagged.hemisphere_assumed,
            "hemisphere-by-xmp": tagged.by == SIGNED,
            "position-by-xmp": tagged.by == FINER,
            "position-contradicts": tagged.by == APART,
            "xmp-unreadable": header.xmp is None,
            "attitude-unknown": a.yaw_deg is None and a.pitch_deg is None,
            "attitude-in-part": (a.yaw_deg is None) != (a.pitch_deg is None),
            "attitude-of-aircraft": a.source in ("dji-flight", "mavlink"),
            "frame-looks-to-horizon": a.pitch_deg is not None and a.pitch_deg > 70.0,
            "image-edited": "viewer" in xmp.get("xap:CreatorTool", "").lower(),
            "positions-all-alike": alike,
            "position-far-away": is_far,
        }
        for code in (code for code, concerns in cases.items() if concerns):
            concerned[code].append(header.name)
    warnings = []
    for code, which in concerned.items():
        if which:
            n = len(headers)
            few = f" ({len(which)} of {n} frames: {some(which)})" if len(which) < n else ""
            warnings.append(Warn(code, which[0] if len(which) == 1 else "", _TEXTS[code] + few))
    return warnings
