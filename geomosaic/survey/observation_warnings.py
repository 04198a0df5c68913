"""What is assumed or doubtful about the positions and attitudes of frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomosaic.survey.extent import away_m
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.model import Attitude, Position, Warn
from geomosaic.survey.names import some
from geomosaic.survey.onboard import onboard_heights
from geomosaic.survey.tagged_place import APART, FINER, SIGNED, TaggedPlace, tagged_place


def observation_warnings(
    headers: Sequence[FrameHeader], positions: Sequence[Position], attitudes: Sequence[Attitude]
) -> list[Warn]:
    """What is assumed or doubtful, once each for all frames it concerns."""
    names = [h.name for h in headers]
    heights = [onboard_heights(h.exif, h.xmp or {}) for h in headers]
    from_exif = [
        p.height_ellipsoidal_m == h.height_m and p.source != "pos"
        for p, h in zip(positions, heights, strict=True)
    ]
    relative = [p.height_above_ground_m == h.above_ground_m for p, h in zip(positions, heights, strict=True)]
    nowhere = TaggedPlace(np.nan, np.nan)
    tagged = [
        (tagged_place(h.exif, h.xmp or {}) if p.source != "pos" else None) or nowhere
        for h, p in zip(headers, positions, strict=True)
    ]
    at = {(p.lon_deg, p.lat_deg) for p in positions if p.known}
    known = np.array([p.known for p in positions])
    away = away_m(positions)
    far = away > np.maximum(5000.0, 20.0 * np.median(away[known] if known.any() else away))
    cases = {
        "position-missing": (
            [not p.known for p in positions],
            "no position: placed by the images",
        ),
        "height-datum-unknown": (
            [h.datum_unknown and e for h, e in zip(heights, from_exif, strict=True)],
            "the altitude's vertical datum is unknown, taken as ellipsoidal with its wide sigma; give "
            "--height-datum if you know it",
        ),
        "height-unknown": (
            [
                p.known and p.height_ellipsoidal_m is None and p.height_above_ground_m is None
                for p in positions
            ],
            "no height at all",
        ),
        "height-above-take-off": (
            [h.above_take_off and r for h, r in zip(heights, relative, strict=True)],
            "height above the take-off point taken as height above ground",
        ),
        "hemisphere-assumed": (
            [t.hemisphere_assumed for t in tagged],
            "EXIF doesn't say north or south, east or west: taken as north and east",
        ),
        "hemisphere-by-xmp": (
            [t.by == SIGNED for t in tagged],
            "EXIF and XMP differ in north or south, east or west: XMP's signs are taken",
        ),
        "position-by-xmp": (
            [t.by == FINER for t in tagged],
            "EXIF's position is cut to whole seconds or minutes of arc: XMP's is taken",
        ),
        "position-contradicts": (
            [t.by == APART for t in tagged],
            "EXIF and XMP give different positions: EXIF's is taken; if the map lies wrong, give positions "
            "by --pos",
        ),
        "xmp-unreadable": ([h.xmp is None for h in headers], "the XMP packet is damaged and was not used"),
        "attitude-unknown": (
            [a.yaw_deg is None and a.pitch_deg is None for a in attitudes],
            "no attitude: taken to look down, heading unknown",
        ),
        "attitude-in-part": (
            [(a.yaw_deg is None) != (a.pitch_deg is None) for a in attitudes],
            "only part of the attitude is known; the rest as for frames without any",
        ),
        "attitude-of-aircraft": (
            [a.source == "dji-flight" for a in attitudes],
            "only the aircraft's attitude is known, pitch and roll are not the camera's",
        ),
        "frame-looks-to-horizon": (
            [a.pitch_deg is not None and a.pitch_deg > 70.0 for a in attitudes],
            "the camera looks to the horizon or up",
        ),
        "image-edited": (
            ["viewer" in (h.xmp or {}).get("xap:CreatorTool", "").lower() for h in headers],
            "saved by an image viewer after the flight: may have been turned",
        ),
        "positions-all-alike": (
            [len(at) == 1 and int(known.sum()) > 1] * len(positions),
            "all frames have the same position: only their overlaps show how they lie to each other",
        ),
        "position-far-away": (
            [*far],
            "the position lies far from all others",
        ),
    }
    warnings = []
    for code, (concerned, text) in cases.items():
        which = [name for name, c in zip(names, concerned, strict=True) if c]
        if which:
            few = f" ({len(which)} of {len(names)} frames: {some(which)})" if len(which) < len(names) else ""
            warnings.append(Warn(code, which[0] if len(which) == 1 else "", text + few))
    return warnings
