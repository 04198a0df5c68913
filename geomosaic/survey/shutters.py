"""How long a camera takes to read a frame's rows: by its tags, by its model, or nobody knows."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from geomosaic.constants import ASSUMED_SD_SHARE, sourced, tuned
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.plausible import SLOWEST
from geomosaic.survey.xmp import number

READOUTS_S = sourced(
    {
        "phantom vision fc200": 0.074, "fc300c": 0.033, "fc300s": 0.033, "fc300x": 0.033, "fc330": 0.033,
        "fc350": 0.030, "fc7203": 0.020, "fc3170": 0.027, "fc3411": 0.032, "fc3582": 0.026,
        "l1d-20c": 0.056, "e90": 0.044, "hero4 black": 0.030, "hero8 black": 0.017,
    },
    "s",
    "first row to last by EXIF's model: without it, lines flown to and fro shrink and stretch",
    "OpenDroneMap, opendm/rollingshutter.py, by users with a blinking light",
)  # fmt: skip
_READOUTS_BY_SIZE = sourced(
    {"fc3582": (40.0, 60.0, 0.060), "fc7203": (10.5, 14.0, 0.025), "l1d-20c": (15.0, 17.0, 0.047)},
    "megapixels from and to, s",
    "images of other sizes than most by the model, which read other rows",
    "OpenDroneMap, opendm/rollingshutter.py",
)
GLOBAL_SHUTTERS: Final = {
    "fc6310", "fc6310r", "fc6310s", "fc6360", "fc6510", "m3e", "zenmusep1", "s.o.d.a.",
    "rededge", "rededge-m", "rededge-mx", "altum",
}  # fmt: skip
"""Models with a mechanical or global shutter by their makers' data sheets."""
STILL_CAMERAS: Final = {
    "canon", "nikon", "nikon corporation", "sony", "olympus corporation", "olympus imaging corp.",
    "pentax", "ricoh", "ricoh imaging company, ltd.", "fujifilm", "panasonic", "leica camera ag",
    "phase one", "samsung",
}  # fmt: skip
"""Makers whose cameras close a shutter before the sensor, in 4 ms or less, unless they are set not to."""
_PHONES: Final = re.compile(r"(sm|xq|gt|so)-|xperia|galaxy")
"""Phones of makers who make still cameras too: their shutters are rolling."""
UNREPORTED_SD_S = tuned(0.04, "s", "without a report, 0 or 0.02 to 0.1: less hides what is open")
_BANDS_AT_ONCE = sourced(
    {("sequoia", 1)},
    "model, bands",
    "cameras that tag a line time but expose all lines at once: used, it would bend frames",
    "Parrot Sequoia's one-band cameras; docs/inputs.md",
)


@dataclass(frozen=True)
class Shutter:
    """How a frame's rows are read.

    readout_s, sd_s: time from the first row to the last, 0 for a global shutter, and its deviation, 0 where
    it is known. source: `tag`, `model`, `global`, `unreported`, `absurd` for a tag that can't be, `turned`
    for an upright frame. The columns of such a frame were read one after the other, from an end that nothing
    reports.
    """

    readout_s: float
    sd_s: float
    source: str


def shutter(header: FrameHeader) -> Shutter:
    """By `Camera:LineReadoutTime` (ns, of all rows), DJI's `ShutterType`, or the model."""
    found = _of_sensor(header)
    upright = header.height_px > header.width_px
    return Shutter(0.0, 0.0, "turned") if upright and found.source in ("tag", "model") else found


def _of_sensor(header: FrameHeader) -> Shutter:
    xmp, model = header.xmp or {}, header.exif.model.lower().strip()
    if (model, header.bands) in _BANDS_AT_ONCE:
        return Shutter(0.0, 0.0, "global")
    line_ns = number(xmp, "Camera:LineReadoutTime") or 0.0
    seconds = 1e-9 * line_ns * (header.exif.height_px or header.height_px)
    if seconds:
        possible = 0.0 <= seconds <= SLOWEST.value
        return Shutter(seconds, 0.0, "tag") if possible else Shutter(0.0, UNREPORTED_SD_S, "absurd")
    mechanical = xmp.get("drone-dji:ShutterType", "").lower() == "mechanical"
    still = header.exif.make.lower().strip() in STILL_CAMERAS and not _PHONES.match(model)
    if mechanical or model in GLOBAL_SHUTTERS or still:
        return Shutter(0.0, 0.0, "global")
    if model in READOUTS_S:
        width_px, height_px = header.exif.width_px, header.exif.height_px
        size = 1e-6 * (width_px or header.width_px) * (height_px or header.height_px)
        least, most, other_s = _READOUTS_BY_SIZE.get(model, (0.0, 0.0, 0.0))
        seconds = other_s if least <= size < most else READOUTS_S[model]
        return Shutter(seconds, ASSUMED_SD_SHARE * seconds, "model")
    return Shutter(0.0, UNREPORTED_SD_S, "unreported")
