"""A multispectral rig's flight: frames of a simulated survey as raw files of MicaSense's, DJI's or Parrot's
cameras, with panels photographed before and after it."""

from __future__ import annotations

import base64
import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bytes, Floats
from geomosaic.survey.header import FrameHeader, read_header
from geomosaic_simulate.exif import (
    ExifTag,
    camera_tags,
    gps_tags,
    long_tag,
    rational_tag,
    short_tag,
    tiff_bytes,
    xmp_packet,
)

BANDS: Final[Mapping[str, tuple[float, Callable[[Floats], Floats]]]] = {
    "Green": (560.0, lambda rgb: 0.04 + 0.5 * rgb[..., 1]),
    "Red": (668.0, lambda rgb: 0.03 + 0.4 * rgb[..., 0]),
    "NIR": (840.0, lambda rgb: 0.75 - 0.6 * rgb[..., 2]),
}
"""Wavelength in nm of each band, and the reflectance that it shows where a picture has colours of 0 to 1."""
PANEL_TEXT: Final = "RP04-1924106-OB04005130900487"
"""A panel's code: albedo 0.513 at 400 nm, 0.487 at 900 nm."""
MAKERS: Final = ("micasense", "dji", "parrot")
_GRASS, _INK, _PAPER = 0.12, 0.04, 0.6
_CODE_MM, _PANEL_MM, _APART_MM = 90.0, 152.0, 145.8
_PX_PER_MM = 1.2
_FALL = (1.0e-5, -4.0e-7, 3.0e-10, -6.0e-14, -2.0e-16, 1.0e-19)
_LEVELS = 65536.0


@dataclass(frozen=True)
class RigFlight:
    """maker: one of MAKERS. panels: whether a panel is photographed before and after the flight, with_code:
    one whose code can be read. sun_sensor: '', 'level' (it reports what falls on level ground) or 'tilted'
    (its reading and its angles). cloudy: by how much the light changes during the flight: in a cloud, or
    evenly where there is no sun sensor."""

    maker: str = "micasense"
    panels: bool = True
    with_code: bool = True
    sun_sensor: str = "level"
    cloudy: float = 0.4
    seed: int = 1


def panel_albedo(wavelength_nm: float) -> float:
    """What PANEL_TEXT means."""
    return 0.513 + (0.487 - 0.513) * (wavelength_nm - 400.0) / 500.0


def reflectance(band: str, rgb: Bytes) -> Floats:
    """The true reflectance of a picture's pixels (rows, cols, 3) in a band."""
    return np.asarray(BANDS[band][1](rgb.astype(np.float64) / 255.0))


def rig_flight(frames: Path, out: Path, flight: RigFlight = RigFlight()) -> dict[str, Floats]:
    """Writes a folder of raw files, one a band and capture, of a survey's JPEG frames; gives the true
    reflectance of each file by its name. The panels' captures are called P0001 and P0002."""
    out.mkdir(parents=True)
    headers = [read_header(path) for path in sorted(frames.glob("*.jpg"))]
    truth: dict[str, Floats] = {}
    times = [h.exif.time_s or 0.0 for h in headers]
    shots: list[tuple[str, FrameHeader, Bytes | None]] = [(h.path.stem, h, _picture(h.path)) for h in headers]
    if flight.panels:
        for name, of, time_s in (
            ("P0001", headers[0], times[0] - 60.0),
            ("P0002", headers[-1], times[-1] + 60.0),
        ):
            low = replace(of.exif, time_s=time_s, altitude_m=(of.exif.altitude_m or 0.0) - 48.0)
            shots.append((name, replace(of, exif=low), None))
    for name, header, rgb in shots:
        time_s = header.exif.time_s or 0.0
        share = (time_s - times[0]) / max(times[-1] - times[0], 1.0)
        light = 1.0 - flight.cloudy * math.sin(math.pi * min(max(share, 0.0), 1.0)) ** 2
        if not flight.sun_sensor:
            light = 1.0 - flight.cloudy * (time_s - times[0] + 60.0) / (times[-1] - times[0] + 120.0)
        for k, band in enumerate(BANDS):
            shown = _panel(header, band, flight) if rgb is None else reflectance(band, rgb)
            file = f"{name}_{k + 1}.tif"
            (out / file).write_bytes(_raw(header, (name, band, k), shown, light, flight))
            truth[file] = shown
    return truth


def _picture(path: Path) -> Bytes:
    bgr = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None
    return np.asarray(bgr[..., ::-1], dtype=np.uint8)


def _panel(header: FrameHeader, band: str, flight: RigFlight) -> Floats:
    """Grass with a code and the panel to its left, or with the panel alone in the middle."""
    rows, cols = header.height_px, header.width_px
    shown = np.full((rows, cols), _GRASS)
    half = round(_PANEL_MM * _PX_PER_MM / 2.0)
    row, col = rows // 2, cols // 2
    if flight.with_code:
        code = cv2.QRCodeEncoder.create().encode(PANEL_TEXT)
        modules = len(code) - 4
        side = round(_CODE_MM * _PX_PER_MM * len(code) / modules)
        code = cv2.resize(code, (side, side), interpolation=cv2.INTER_NEAREST)
        at = cols // 2 + round(_APART_MM * _PX_PER_MM / 2.0)
        top, left = row - side // 2, at - side // 2
        shown[top : top + side, left : left + side] = np.where(code > 0, _PAPER, _INK)
        col = at - round(_APART_MM * _PX_PER_MM)
    shown[row - half : row + half, col - half : col + half] = panel_albedo(BANDS[band][0])
    return shown


def _raw(
    header: FrameHeader,
    named: tuple[str, str, int],
    shown: Floats,
    light: float,
    flight: RigFlight,
) -> bytes:
    """A file as the camera writes it. Args: named: the capture, the band and its number."""
    capture, band, k = named
    rng = np.random.default_rng([flight.seed, k, *capture.encode()])
    exposure_us = int(rng.integers(300, 900))
    sensor_gain = float(rng.choice([1, 2]))
    full = 1.1 - 0.15 * k  # of the sun in this band, in W/m2/nm
    camera = {"micasense": _micasense, "dji": _dji, "parrot": _parrot}[flight.maker]
    values, black, tags = camera(header, shown, full * light, (exposure_us, sensor_gain), flight)
    noisy = np.rint(values + rng.normal(0.0, 30.0, values.shape)).clip(0.0, 65535.0).astype(np.uint16)
    place = {"Camera:BandName": band, "Camera:CaptureUUID": capture}
    place |= {"Camera:CentralWavelength": f"{BANDS[band][0]:g}", "Camera:RigCameraIndex": f"{k}"}
    turned = {n: v for n, v in (header.xmp or {}).items() if n.startswith("drone-dji:")}
    return _tiff(header, noisy, (exposure_us, sensor_gain, black), {**turned, **place, **tags})


def _micasense(
    header: FrameHeader, shown: Floats, irradiance: float, setting: tuple[int, float], flight: RigFlight
) -> tuple[Floats, float, dict[str, str]]:
    exposure_s, a1, a2, a3 = setting[0] * 1e-6, 6e-4, 1.1e-7, 2.0e-5
    row = np.arange(header.height_px)[:, None]
    fall = _radial(header)
    radiance = shown * irradiance / math.pi
    counts = radiance * setting[1] / a1 * (exposure_s + a2 * row - a3 * exposure_s * row)
    tags = {
        "MicaSense:RadiometricCalibration": f"{a1},{a2},{a3}",
        "Camera:VignettingCenter": f"{header.width_px / 2 + 7},{header.height_px / 2 - 5}",
        "Camera:VignettingPolynomial": ",".join(f"{c}" for c in _FALL),
    }
    if flight.sun_sensor == "level":
        tags |= {
            "DLS:HorizontalIrradiance": f"{100.0 * irradiance:.5f}",
            "DLS:IrradianceScaleToSIUnits": "0.01",
        }
    if flight.sun_sensor == "tilted":
        tags |= _tilted_reading(header, irradiance)
    return 4800.0 + counts * fall * _LEVELS, 4800.0, tags


def _tilted_reading(header: FrameHeader, irradiance: float) -> dict[str, str]:
    """Of a first-generation sensor: the share of light from the sun by the cosine of its incidence."""
    from geomosaic.geodesy.sun import sun_direction
    from geomosaic.radiometry.sun_sensor import sensor_axis, transmitted

    exif = header.exif
    sun = sun_direction(exif.lon_deg or 0.0, exif.lat_deg or 0.0, exif.time_s or 0.0)
    yaw, pitch, roll = 0.4, 0.12, -0.08
    incidence = math.acos(float(sensor_axis(yaw, pitch, roll) @ sun))
    direct = irradiance / (float(sun[2]) + 1.0 / 6.0)
    reading = direct * (math.cos(incidence) + 1.0 / 6.0) * transmitted(incidence)
    return {
        "DLS:SpectralIrradiance": f"{reading:.7f}",
        "DLS:Yaw": f"{yaw}",
        "DLS:Pitch": f"{pitch}",
        "DLS:Roll": f"{roll}",
    }


def _dji(
    header: FrameHeader, shown: Floats, irradiance: float, setting: tuple[int, float], flight: RigFlight
) -> tuple[Floats, float, dict[str, str]]:
    adjustment, factor = 1.04, 700.0
    counts = shown * irradiance * factor * setting[1] * setting[0] * 1e-6 / adjustment
    tags = {
        "drone-dji:SensorGain": f"{setting[1]}",
        "drone-dji:ExposureTime": f"{setting[0]}",
        "drone-dji:SensorGainAdjustment": f"{adjustment}",
        "drone-dji:BlackCurrent": "3200",
        "drone-dji:CalibratedOpticalCenterX": f"{header.width_px / 2 + 7}",
        "drone-dji:CalibratedOpticalCenterY": f"{header.height_px / 2 - 5}",
        "drone-dji:VignettingData": ", ".join(f"{-c}" for c in _FALL),
    }
    if flight.sun_sensor:
        tags["drone-dji:Irradiance"] = f"{3000.0 * irradiance:.4f}"
    return 3200.0 + counts / (2.0 - _radial(header)) * (_LEVELS - 1.0), 3200.0, tags


def _parrot(
    header: FrameHeader, shown: Floats, irradiance: float, setting: tuple[int, float], flight: RigFlight
) -> tuple[Floats, float, dict[str, str]]:
    iso, exposure_s, a, b, c = 100.0 * setting[1], setting[0] * 1e-6, 16000.0, 4000.0, 1.0
    col, row = np.arange(header.width_px) / header.width_px, np.arange(header.height_px) / header.height_px
    fall = 0.7 + 1.1 * col - 1.05 * col**2 + (0.1 * row - 0.12 * row**2)[:, None]
    counts = shown * irradiance * 3.0e2 * (a * exposure_s * iso + c) / 2.8**2
    tags = {
        "Camera:SensorModel": f"{a},{b},{c}",
        "Camera:VignettingPolynomial2DName": "0,0,1,0,2,0,0,1,0,2",
        "Camera:VignettingPolynomial2D": "0.7,1.1,-1.05,0.1,-0.12",
        "Camera:IrradianceCalibrationMeasurement": "0,600,150,20,1,600,3660,420,2,600,60950,6980",
    }
    if flight.sun_sensor:
        index, ms = 1, 100
        count = round(irradiance * 3660.0 / 600.0 * ms * 20.0)
        record = struct.pack("<Q4H3f", 10**9, count, 50, index, ms, 0.0, 0.0, 0.0)
        tags["Camera:IrradianceList"] = base64.b64encode(record * 3).decode()
    return b + counts * fall, b, tags


def _radial(header: FrameHeader) -> Floats:
    """The light that _FALL leaves."""
    col = np.arange(header.width_px) - (header.width_px / 2.0 + 7.0)
    row = np.arange(header.height_px)[:, None] - (header.height_px / 2.0 - 5.0)
    r = np.hypot(col, row)
    return np.asarray(1.0 + sum(c * r ** (i + 1) for i, c in enumerate(_FALL)))


def _tiff(
    header: FrameHeader,
    values: NDArray[np.uint16],
    setting: tuple[int, float, float],
    xmp: Mapping[str, str],
) -> bytes:
    """A TIFF in one strip. Args: setting: exposure in us, sensor gain, black level."""
    exif, (rows, cols) = header.exif, values.shape
    exposure = Fraction(setting[0], 1_000_000)
    per_mm = Fraction(exif.pixels_per_mm or 100.0).limit_denominator(10_000)
    size, focal_35mm = (cols, rows), round(exif.focal_length_35mm or 0.0)
    time_s, focal_mm = exif.time_s or 0.0, exif.focal_length_mm or 5.0
    main, inner = camera_tags(time_s, "Maker", "Rig", size, focal_mm, per_mm, focal_35mm, exposure)
    gains = (0x8827, 0x829D)
    inner = [tag for tag in inner if tag.number not in gains]
    inner += [short_tag(0x8827, round(100.0 * setting[1])), rational_tag(0x829D, Fraction(28, 10))]
    place = gps_tags(time_s, exif.lon_deg or 0.0, exif.lat_deg or 0.0, exif.altitude_m)

    def block(strip: int) -> bytes:
        image = [
            long_tag(0x0100, cols), long_tag(0x0101, rows), short_tag(0x0102, 16), short_tag(0x0103, 1),
            short_tag(0x0106, 1), long_tag(0x0111, strip), short_tag(0x0115, 1), long_tag(0x0116, rows),
            long_tag(0x0117, values.nbytes), ExifTag(0x02BC, 1, xmp_packet(xmp)),
            ExifTag(0xC61A, 3, struct.pack("<4H", *[round(setting[2])] * 4)),
        ]  # fmt: skip
        return tiff_bytes([*main, *image], inner, place)

    return block(len(block(0))) + values.astype("<u2").tobytes()
