"""Focal lengths in pixels as a frame's tags and tables of published sensors report them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from geomosaic.constants import sourced, tuned
from geomosaic.survey.header import FrameHeader

FILM_DIAGONAL_MM = sourced(math.hypot(36.0, 24.0), "mm", "diagonal of 35 mm equivalents", "CIPA DCG-001")
SENSOR_WIDTHS_MM = sourced(
    {
        **dict.fromkeys(("fc300c", "fc300s", "fc300x", "fc330", "fc220", "fc350", "dsc-wx220"), 6.17),
        **dict.fromkeys(("fc6310", "fc6310r", "fc6310s", "fc6510", "l1d-20c", "fc3411"), 13.2),
        **dict.fromkeys(("fc550", "fc6520", "e-p1", "e-p2", "e-pl1"), 17.3),
        **dict.fromkeys(("zenmusep1", "ilce-7rm2"), 35.9),
        "s.o.d.a.": 13.13,
        "m3e": 17.46,
        "l2d-20c": 17.5,
        "ilce-6000": 23.5,
    },
    "mm",
    "width of the whole sensor by EXIF's model: a wrong one scales the focal length",
    "formats: 1/2.3 inch 6.17, 1 inch 13.2, APS-C 23.5, 4/3 17.3, 35 mm 35.9; DroneModels; OpenSfM",
)


@dataclass(frozen=True)
class Sensor:
    """widths_px: of the versions sold, the usual one first; shapes: their ratios of sides, empty for any;
    focal_mm: of a lens that can't be changed."""

    widths_px: tuple[int, ...]
    pitch_um: float
    focal_mm: float | None = None
    shapes: tuple[float, ...] = ()


_UNCOOLED = sourced((640 / 512, 336 / 256), "ratio", "of thermal frames", "data sheets: 640 x 512, 336 x 256")
SENSORS = sourced(
    {
        "zh30t": Sensor((1280,), 12.0, 24.0, _UNCOOLED),
        "h20t": Sensor((640,), 12.0, 13.5, _UNCOOLED),
        "mavic2-enterprise-advanced": Sensor((640,), 12.0, 9.0, _UNCOOLED),
        "m30t": Sensor((640,), 12.0, 9.1, _UNCOOLED),
        "m3t": Sensor((640,), 12.0, 9.1, _UNCOOLED),
        "xt2": Sensor((640, 336), 17.0, None, _UNCOOLED),
        "tz20": Sensor((640,), 12.0, None, _UNCOOLED),
        "boson": Sensor((640, 320), 12.0, None, _UNCOOLED),
        "flir": Sensor((640, 336), 17.0, None, _UNCOOLED),
        "vue pro": Sensor((640, 336), 17.0, None, _UNCOOLED),
        "ov5647": Sensor((2592,), 1.4, 3.6),
        "imx219": Sensor((3280,), 1.12, 3.04),
        "imx708_wide": Sensor((4608,), 1.4, 2.75),
        "imx708": Sensor((4608,), 1.4, 4.74),
        "imx477": Sensor((4056,), 1.55),
    },
    "px, um, mm",
    "pixel pitch by part of make and model, the first that fits; a wrong one scales the focal length",
    "Theta-Limited/DroneModels; QGroundControl; Raspberry Pi; M30T as M3T, Vue TZ20 as Boson, others Tau 2",
)
SAME_SHAPE = tuned(0.003, "share", "of a ratio of sides: 336 x 256 and 4:3 differ by 0.016; more takes crops")
_ONE_LENGTH: Final = {"zr10"}
"""Models of zooms that tag the long end, up to 9 times too long, at any zoom (ArduPilot, AP_Mount_Siyi.cpp:
ZR10, 5.15 to 47.38 mm)."""
_ACTION_MAKES: Final = {"gopro", "xiaoyi", "sjcam", "drift"}
"""Of action cameras, which have several fields of view and do not tag the mode (OpenSfM,
opensfm/data/camera_calibration.yaml: all but sjcam)."""
_WIDE_MODE_MM = sourced(16.0, "equivalent mm", "longest fisheye mode", "OpenSfM: GoPro wide 15 and 16")
_ACTION = sourced(0.47, "focal / side", "of wide modes", "OpenSfM: 0.466 and 0.47; gyroflow: 0.444")
ALIKE = tuned(0.15, "share", "of two sources: rounded equivalents differ by some %, a cropped image by more")
_USUAL = sourced(0.85, "focal / side", "where nothing reports one", "OpenSfM: default_focal_prior")
_WIDEST_FLAT = sourced(0.25, "focal / side", "shorter is a fisheye", "Laowa 9 mm on 36 mm: 0.25")


@dataclass(frozen=True)
class Reported:
    """Focal lengths in pixels of a frame by source, the surest first; pixels_per_mm: of the frame, None where
    nothing reports it."""

    by_source: dict[str, float]
    pixels_per_mm: float | None


def reported_focal_lengths(header: FrameHeader) -> Reported:
    """What the tables and EXIF say of a frame's focal length.

    `sensor-pitch`: the lens in mm on a sensor of known pitch. It goes before all others, since what EXIF adds
    there is of another camera of the same drone. `focal-plane`: the lens in mm with EXIF's resolution.
    `sensor-table`: the lens in mm with the sensor's width. `exif-35mm`: the 35 mm equivalent, which compares
    diagonals (CIPA DCG-001). For frames wider than 3:2 the diagonal is that of the 4:3 sensor they are cut
    from. The longer side is the sensor's width: an upright frame is one whose pixels were turned.

    A digital zoom enlarges a part of the sensor and leaves the lens in mm as it is. Focal lengths that follow
    from the lens are multiplied by it. Most cameras count it in the 35 mm equivalent, which is never
    multiplied. A focal length that agrees with the equivalent better as it is stays so. `sensor-pitch` stays
    as well, since the zoom may be of another camera of the same drone.
    """
    exif, height, width = header.exif, *sorted((header.width_px, header.height_px))
    if exif.model.lower().strip() in _ONE_LENGTH:
        return Reported({}, None)
    sensor = _sensor(header)
    if sensor is not None:
        mm = sensor.focal_mm or exif.focal_length_mm
        native = width if width in sensor.widths_px else sensor.widths_px[0]
        per_mm = 1000.0 / sensor.pitch_um * width / native
        return Reported({} if mm is None else {"sensor-pitch": mm * per_mm}, per_mm)
    stated = max(exif.width_px or 0, exif.height_px or 0) if exif.width_px else 0
    scale = width / stated if stated else 1.0
    per_mm_by_tag = None if exif.pixels_per_mm is None else exif.pixels_per_mm * scale
    sensor_mm = SENSOR_WIDTHS_MM.get(exif.model.lower().strip())
    per_mm_by_table = None if sensor_mm is None else width / sensor_mm
    focals: dict[str, float] = {}
    if exif.focal_length_mm is not None:
        by_mm = {"focal-plane": per_mm_by_tag, "sensor-table": per_mm_by_table}
        focals = {name: exif.focal_length_mm * per for name, per in by_mm.items() if per is not None}
    if exif.focal_length_35mm is not None:
        diagonal = math.hypot(width, height) if width <= 1.55 * height else 1.25 * width
        focals["exif-35mm"] = exif.focal_length_35mm * diagonal / FILM_DIAGONAL_MM
    return Reported(_zoomed(focals, exif.digital_zoom or 1.0), per_mm_by_tag or per_mm_by_table)


def _zoomed(focals: dict[str, float], zoom: float) -> dict[str, float]:
    """Focal lengths in pixels by source, those that lack the digital zoom multiplied by it."""
    equivalent = focals.get("exif-35mm")
    found = dict(focals)
    for source, focal in focals.items():
        if source != "exif-35mm" and zoom > 1.0:
            lacks = equivalent is None or equivalent > focal * math.sqrt(zoom)
            found[source] = zoom * focal if lacks else focal
    return found


def _sensor(header: FrameHeader) -> Sensor | None:
    called = f"{header.exif.make} {header.exif.model}".lower()
    longer, shorter = max(header.width_px, header.height_px), min(header.width_px, header.height_px)
    for words, sensor in SENSORS.items():
        off = [abs(longer / shorter / shape - 1.0) for shape in sensor.shapes]
        if words in called and min(off, default=0.0) <= SAME_SHAPE:
            return sensor
    return None


def agreed(focals: dict[str, float]) -> str | None:
    """The first source that another one agrees with, or the only one; None where they contradict each
    other."""
    for source, focal in focals.items():
        others = [value for other, value in focals.items() if other != source]
        if not others or any(abs(value / focal - 1.0) < ALIKE for value in others):
            return source
    return None


def action_camera(header: FrameHeader) -> bool:
    """Whether the frame is of an action camera, by its make."""
    return header.exif.make.lower().strip() in _ACTION_MAKES


def wide_mode(header: FrameHeader) -> bool:
    """Whether the frame is of an action camera's wide mode, which it is where no tag says otherwise."""
    equivalent_mm = header.exif.focal_length_35mm
    return action_camera(header) and (equivalent_mm is None or equivalent_mm <= _WIDE_MODE_MM)


def usual_focal_px(header: FrameHeader) -> float:
    """Where a lens begins of which nothing is reported."""
    return (_ACTION if wide_mode(header) else _USUAL) * max(header.width_px, header.height_px)


def too_wide(focal_px: float, width_px: int, height_px: int) -> bool:
    """Whether no lens that maps planes to planes is as short."""
    return focal_px < _WIDEST_FLAT * max(width_px, height_px)


def nearest_to_usual(focals: dict[str, float], usual_px: float) -> float:
    """Of focal lengths that contradict each other, the one that most cameras are nearest to."""
    return min(focals.values(), key=lambda focal: abs(math.log(focal / usual_px)))
