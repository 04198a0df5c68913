"""The sensor as its maker describes it in a frame's tags: MicaSense, DJI and Parrot."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.constants import sourced
from geomosaic.estimation.robust import LEAST_OBSERVATIONS
from geomosaic.geodesy.sun import sun_direction
from geomosaic.radiometry.calibration import Calibration, Vignetting
from geomosaic.radiometry.quantity import CELSIUS, CENTIKELVIN, Quantity
from geomosaic.radiometry.sun_sensor import horizontal_irradiance, sensor_axis
from geomosaic.survey.header import JPEG_SUFFIXES, FrameHeader
from geomosaic.survey.strays import camera_kind
from geomosaic.survey.xmp import Xmp, number, numbers

_SUNSHINE = sourced(
    np.dtype([("time_us", "<u8"), ("count", "<u2", 2), ("gain", "<u2"), ("ms", "<u2"), ("angle", "<f4", 3)]),
    "bytes",
    "a record of the tag IrradianceList",
    "Parrot developer forum, Details of the IrradianceList tag",
)
_MISREPORTED_S = sourced(
    (1.0 / 6329.0, 0.000274),
    "s",
    "exposure in tags of old firmware, and the true one",
    "MicaSense, imageprocessing",
)
_LIKE_S = sourced(1e-6, "s", "difference of the same exposure", "MicaSense, imageprocessing, metadata.py")
_NEEDED: Final = {
    "micasense": ("MicaSense:RadiometricCalibration", "ExposureTime", "PhotographicSensitivity"),
    "parrot": ("Camera:SensorModel", "ExposureTime", "PhotographicSensitivity", "FNumber"),
    "dji": ("drone-dji:SensorGain", "drone-dji:ExposureTime"),
}
"""The tags that a sensor model can't do without, by the camera's maker in lower case."""
_FULL: Final = np.iinfo(np.uint16).max
"""The largest digital number, and the count of a saturated sunshine sensor."""


@dataclass(frozen=True)
class SensorModel:
    """calibration: to radiance, in a unit of the maker's. irradiance: of level ground by the sun sensor, None
    without a reading. absolute: whether pi * radiance / irradiance is reflectance; else only a panel
    gives the factor."""

    calibration: Calibration
    irradiance: float | None
    absolute: bool


def sensor_model(header: FrameHeader) -> SensorModel | None:
    """Of a frame of one band in 16 bits; None where the tags hold no model that is known here."""
    if header.bands != 1 or header.dtype != "uint16":
        return None
    return next((model for read in (_micasense, _parrot, _dji) if (model := read(header))), None)


def missing_tags(header: FrameHeader) -> list[str]:
    """The tags that the sensor model of the frame's maker needs and the frame lacks. It is empty for other
    makers, and for frames with several bands or not in 16 bits."""
    if header.bands != 1 or header.dtype != "uint16":
        return []
    exif = header.exif
    optics = {"ExposureTime": exif.exposure_s, "PhotographicSensitivity": exif.iso, "FNumber": exif.f_number}
    return [
        tag.split(":")[-1]
        for tag in _NEEDED.get(exif.make.lower(), ())
        if not (optics[tag] if tag in optics else (header.xmp or {}).get(tag))
    ]


def temperature(header: FrameHeader) -> Quantity | None:
    """The quantity of values that are temperatures, None for other values. Temperatures are those of
    MicaSense's thermal band, and floats of a thermal camera, of a band that is called LWIR or of a JPEG."""
    band = (header.xmp or {}).get("Camera:BandName", "").upper() == "LWIR"
    if header.dtype != "float32":
        return CENTIKELVIN if band else None
    thermal = band or camera_kind(header) == "thermal" or header.path.suffix.lower() in JPEG_SUFFIXES
    return CELSIUS if thermal else None


def _micasense(header: FrameHeader) -> SensorModel | None:
    """`L = V a1 / g * (p - pBL) / (t_e + a2 y - a3 t_e y)`, with p as shares of 16 bits and g = 1 at ISO 100.

    Reference: MicaSense, RedEdge Camera Radiometric Calibration Model.
    """
    xmp, exif = header.xmp or {}, header.exif
    factors = numbers(xmp, "MicaSense:RadiometricCalibration", 3)
    if factors is None or not exif.exposure_s or not exif.iso:
        return None
    a1, a2, a3 = factors
    wrong_s, true_s = _MISREPORTED_S
    wrong = exif.model != "Altum" and abs(exif.exposure_s - wrong_s) < _LIKE_S
    exposure_s = true_s if wrong else exif.exposure_s
    gain = a1 / (exif.iso / 100.0 * exposure_s * (_FULL + 1.0))
    centre = numbers(xmp, "Camera:VignettingCenter", 2)
    fall = _radial(numbers(xmp, "Camera:VignettingPolynomial", 6), centre, divides=True)
    fall = fall or _two_dimensional(xmp)
    row_gradient = a2 / exposure_s - a3
    calibration = Calibration(gain, exif.black_level or 0.0, row_gradient, fall)
    return SensorModel(calibration, _downwelling(header), absolute=True)


def _downwelling(header: FrameHeader) -> float | None:
    """Horizontal irradiance in W/m2/nm by MicaSense's downwelling light sensor.

    The direct and the diffuse part where the sensor separates them (DLS 2), else its reading, corrected by
    its orientation and the sun's place (DLS 1).
    """
    xmp, exif = header.xmp or {}, header.exif
    level, direct, diffuse, elevation = (
        number(xmp, f"DLS:{name}", f"Camera:{name}")
        for name in ("HorizontalIrradiance", "DirectIrradiance", "ScatteredIrradiance", "SolarElevation")
    )
    second = level is not None or direct is not None
    scale = number(xmp, "DLS:IrradianceScaleToSIUnits", "Camera:IrradianceScaleToSIUnits")
    scale = (0.01 if second else 1.0) if scale is None else scale
    if direct and diffuse and elevation is not None:
        return scale * (direct * math.sin(elevation) + diffuse)
    if level is not None:
        return scale * level or None
    reading = number(xmp, "DLS:SpectralIrradiance", "Camera:Irradiance")
    angles = [number(xmp, f"DLS:{name}") for name in ("Yaw", "Pitch", "Roll")]
    yaw, pitch, roll = (angle or 0.0 for angle in angles)
    if not reading or exif.lon_deg is None or exif.lat_deg is None or exif.time_s is None:
        return None
    sun = sun_direction(exif.lon_deg, exif.lat_deg, exif.time_s)
    return horizontal_irradiance(scale * reading, sensor_axis(yaw, pitch, roll), sun)


def _dji(header: FrameHeader) -> SensorModel | None:
    """V * pCam * (p - pBL) / (gain * exposure), p as shares of 16 bits; the irradiance is level ground's.

    One factor of all bands is missing to reflectance. Reference: DJI, P4 Multispectral Image Processing Guide
    (2020), eq. 5 to 9; Mavic 3M Image Processing Guide (2023).
    """
    xmp = header.xmp or {}
    sensor_gain = number(xmp, "drone-dji:SensorGain")
    exposure_us = number(xmp, "drone-dji:ExposureTime")
    black = number(xmp, "drone-dji:BlackCurrent", "Camera:BlackCurrent", "drone-dji:BlackLevel")
    black = header.exif.black_level if black is None else black
    if not sensor_gain or not exposure_us or black is None:
        return None
    adjustment = number(xmp, "drone-dji:SensorGainAdjustment") or 1.0
    gain = adjustment / (sensor_gain * exposure_us * 1e-6 * _FULL)
    col, row = (number(xmp, f"drone-dji:CalibratedOpticalCenter{axis}") for axis in "XY")
    centre = None if col is None or row is None else (col, row)
    fall = _radial(numbers(xmp, "drone-dji:VignettingData", 6), centre, divides=False)
    irradiance = number(xmp, "drone-dji:Irradiance", "Camera:Irradiance")
    return SensorModel(Calibration(gain, black, 0.0, fall), irradiance or None, absolute=False)


def _parrot(header: FrameHeader) -> SensorModel | None:
    """I = f² (p - B) / (A e g + C), divided by the vignetting polynomial; e exposure in s, g sensitivity.

    Reference: Parrot, Sequoia application notes: pixel value to irradiance; how to correct vignetting.
    """
    xmp, exif = header.xmp or {}, header.exif
    factors = numbers(xmp, "Camera:SensorModel", 3)
    if factors is None or not exif.exposure_s or not exif.iso or not exif.f_number:
        return None
    a, b, c = factors
    gain = exif.f_number**2 / (a * exif.exposure_s * exif.iso + c)
    return SensorModel(Calibration(gain, b, 0.0, _two_dimensional(xmp)), _sunshine(xmp), absolute=False)


def _sunshine(xmp: Xmp) -> float | None:
    """What Parrot's sunshine sensor counted in a millisecond at gain 1, up to one factor.

    Reference: Parrot developer forum, Details of the IrradianceList tag: counts are proportional to gain,
    exposure and irradiance; the gains follow from the tag IrradianceCalibrationMeasurement.
    """
    try:
        data = base64.b64decode(xmp.get("Camera:IrradianceList", ""), validate=True)
    except ValueError:
        return None
    if not data or len(data) % _SUNSHINE.itemsize:
        return None
    table = _list(xmp, "Camera:IrradianceCalibrationMeasurement")
    gains = {
        index: count / ms
        for index, ms, count in zip(table[::4], table[1::4], table[2::4], strict=False)
        if ms and 0.0 < count < _FULL
    }
    found = [
        float(reading["count"][0]) / float(reading["ms"]) / gains[int(reading["gain"])]
        for reading in np.frombuffer(data, dtype=_SUNSHINE)[-LEAST_OBSERVATIONS:]
        if reading["ms"] and int(reading["gain"]) in gains and 0 < reading["count"][0] < _FULL
    ]
    return float(np.median(found)) if found else None


def _radial(
    polynomial: tuple[float, ...] | None, centre: tuple[float, ...] | None, *, divides: bool
) -> Vignetting | None:
    if polynomial is None or centre is None:
        return None
    return Vignetting(polynomial, (centre[0], centre[1]), divides=divides)


def _two_dimensional(xmp: Xmp) -> Vignetting | None:
    """By Parrot's tags, which newer cameras of MicaSense write too."""
    fall = _list(xmp, "Camera:VignettingPolynomial2D")
    powers = _list(xmp, "Camera:VignettingPolynomial2DName")
    exponents = tuple(zip(powers[::2], powers[1::2], strict=False))
    return Vignetting(fall, exponents=exponents) if fall and len(exponents) == len(fall) else None


def _list(xmp: Xmp, name: str) -> tuple[float, ...]:
    return numbers(xmp, name, xmp.get(name, "").count(",") + 1) or ()
