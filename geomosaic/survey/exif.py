"""EXIF: what a camera says of itself, of the place and of the time."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from typing import Any, Final

from geomosaic.constants import sourced, tuned
from geomosaic.doors.files import printable
from geomosaic.survey.exif_tags import LONGEST_BYTES, Block, Tags, tags_from_block

_FLOAT: Final = r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_FIRST_YEAR = tuned(1900, "year", "an earlier one is of an unset clock and would order frames wrongly")
_MM_PER_UNIT = sourced(
    {2.0: 25.4, 3.0: 10.0, 4.0: 1.0, 5.0: 0.001},
    "mm by unit",
    "of the unit in which a focal plane's resolution is counted",
    "CIPA DC-008 (EXIF) for 2 and 3; ExifTool for 4 and 5",
)


@dataclass(frozen=True)
class Exif:
    """EXIF's facts; None where the file doesn't say or what it says can't be.

    width_px and height_px are the image's as taken, before any later resize. altitude_m has no
    stated datum. time_s is seconds since 1970; a local time without its offset is taken as UTC.
    hemisphere_assumed: the file doesn't say N or S, E or W, and north and east were taken. serial: of the
    camera's body. position_error_m: of the position in plan. iso: sensitivity; black_level: of a value, the
    mean over a sensor's colours. digital_zoom: how many times the image shows a part of the sensor enlarged.
    gimbal_deg: yaw, pitch and roll by DJI's maker note, as in its XMP.
    """

    make: str = ""
    model: str = ""
    width_px: int | None = None
    height_px: int | None = None
    lon_deg: float | None = None
    lat_deg: float | None = None
    altitude_m: float | None = None
    time_s: float | None = None
    focal_length_mm: float | None = None
    focal_length_35mm: float | None = None
    digital_zoom: float | None = None
    pixels_per_mm: float | None = None
    hemisphere_assumed: bool = False
    serial: str = ""
    position_error_m: float | None = None
    exposure_s: float | None = None
    iso: float | None = None
    f_number: float | None = None
    black_level: float | None = None
    gimbal_deg: tuple[float, float, float] | None = None

    @property
    def exposure(self) -> float | None:
        """The exposure time in s that takes as much light at f/1 and ISO 100; a camera that reports no
        f-number has one aperture. None where time or sensitivity are unknown."""
        if self.exposure_s is None or self.iso is None:
            return None
        return self.exposure_s * self.iso / 100.0 / (self.f_number or 1.0) ** 2


_OF_GDAL: Final = {
    "ISOSpeedRatings": "PhotographicSensitivity",
    "SubSecTime_Original": "SubSecTimeOriginal",
    "SubSecTime_Digitized": "SubSecTimeDigitized",
}
"""Names of tags that GDAL writes in its own way."""


def exif_from_block(block: Block) -> Exif:
    """From an EXIF segment's bytes or a whole TIFF file's: a TIFF header and its directories."""
    return _exif(tags_from_block(block))


def exif_from_gdal(items: Mapping[str, str]) -> Exif:
    """From GDAL's metadata items (`EXIF_GPSLatitude: (24) (40) (49.0)`), as gdal_translate keeps them."""
    tags: Tags = {}
    for key, text in items.items():
        name = _OF_GDAL.get(name := key.removeprefix("EXIF_"), name)
        if len(text) > LONGEST_BYTES:
            continue
        if name.startswith("SubSecTime"):  # digits of a fraction: 05 is no 5
            tags[name] = text.strip()
        elif re.fullmatch(rf"(\s*\({_FLOAT}\))+\s*", text):
            tags[name] = tuple(float(n) for n in re.findall(r"[^()\s]+", text))
        elif re.fullmatch(r"(0x[0-9a-fA-F]{1,2}\s*)+", text):
            tags[name] = tuple(float(int(n, 16)) for n in text.split())
        elif re.fullmatch(r"-?[0-9]+", text.strip()):
            tags[name] = (float(text),)
        else:
            tags[name] = text
    return _exif(tags)


def _exif(tags: Tags) -> Exif:
    def text(name: str) -> str:
        value = tags.get(name, "")
        return printable(value.split("\x00")[0].strip()) if isinstance(value, str) else ""

    def number(name: str, positive: bool = True) -> float | None:
        value = tags.get(name)
        if not isinstance(value, tuple) or len(value) != 1 or not math.isfinite(value[0]):
            return None
        return None if positive and value[0] <= 0.0 else value[0]

    def whole(name: str) -> int | None:
        value = number(name)
        return None if value is None else round(value)

    lat = _degrees(tags.get("GPSLatitude"), text("GPSLatitudeRef"), "S", 90.0)
    lon = _degrees(tags.get("GPSLongitude"), text("GPSLongitudeRef"), "W", 180.0)
    if lat is None or lon is None or (lat == 0.0 and lon == 0.0):  # 0, 0: a receiver without a fix
        lat = lon = None
    altitude = number("GPSAltitude", positive=False)
    yaw, pitch, roll = (number(f"Gimbal{axis}Degree", positive=False) for axis in ("Yaw", "Pitch", "Roll"))
    below = number("GPSAltitudeRef") in (1.0, 3.0)  # EXIF 3.0: 2 and 3 are above and below the ellipsoid
    per_unit, black = number("FocalPlaneXResolution"), tags.get("BlackLevel")
    mm = _MM_PER_UNIT.get(number("FocalPlaneResolutionUnit") or 2.0)
    return Exif(
        make=text("Make"),
        model=text("Model"),
        width_px=whole("PixelXDimension") or whole("ExifImageWidth"),
        height_px=whole("PixelYDimension") or whole("ExifImageLength"),
        lon_deg=lon,
        lat_deg=lat,
        altitude_m=-altitude if altitude is not None and below else altitude,
        time_s=_time_s(text),
        focal_length_mm=number("FocalLength"),
        focal_length_35mm=number("FocalLengthIn35mmFilm"),
        digital_zoom=number("DigitalZoomRatio"),  # 0: it was not used
        pixels_per_mm=None if per_unit is None or mm is None else per_unit / mm,
        hemisphere_assumed=lat is not None and not (text("GPSLatitudeRef") and text("GPSLongitudeRef")),
        serial=text("BodySerialNumber") or text("SerialNumber"),
        position_error_m=number("GPSHPositioningError"),
        exposure_s=number("ExposureTime"),
        iso=number("ISOSpeed") or number("PhotographicSensitivity"),
        f_number=number("FNumber"),
        black_level=sum(black) / len(black) if isinstance(black, tuple) and black else None,
        gimbal_deg=None if yaw is None or pitch is None or roll is None else (yaw, pitch, roll),
    )


def _degrees(value: object, ref: str, negative_ref: str, limit_deg: float) -> float | None:
    if not isinstance(value, tuple) or not 1 <= len(value) <= 3:
        return None
    degrees = float(sum(part / 60.0**i for i, part in enumerate(value)))
    if not math.isfinite(degrees) or not 0.0 <= degrees <= limit_deg:
        return None
    return -degrees if ref[:1].upper() == negative_ref else degrees


def _time_s(text: Any) -> float | None:
    for name in ("DateTimeOriginal", "DateTimeDigitized", "DateTime"):
        match = re.match(r"(\d{4})[:-](\d\d)[:-](\d\d)[ T](\d\d):(\d\d):(\d\d)", text(name))
        if match is None or int(match[1]) < _FIRST_YEAR:
            continue
        try:
            moment = datetime(*(int(part) for part in match.groups()), tzinfo=UTC)  # type: ignore[misc,arg-type]
        except ValueError:
            continue
        zone = text(name.replace("DateTime", "OffsetTime")) or text("OffsetTime")
        offset = re.fullmatch(r"([+-])(\d\d):(\d\d)", zone)
        if offset:
            minutes = int(offset[2]) * 60 + int(offset[3])
            if minutes < 24 * 60:
                east = timedelta(minutes=minutes if offset[1] == "+" else -minutes)
                moment = moment.replace(tzinfo=timezone(east))
        fraction = re.fullmatch(r"\d+", text(name.replace("DateTime", "SubSecTime")) or text("SubSecTime"))
        return moment.timestamp() + (float(f"0.{fraction[0]}") if fraction else 0.0)
    return None
