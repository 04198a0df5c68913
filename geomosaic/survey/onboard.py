"""Position and attitude as the drone wrote them into the image: EXIF and XMP put together."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Floats
from geomosaic.camera.rotation import Rotation
from geomosaic.constants import sourced
from geomosaic.survey.accuracy import ATTITUDE, POSITION, RTK_SD_FLOOR_M
from geomosaic.survey.exif import Exif
from geomosaic.survey.header import FrameHeader
from geomosaic.survey.model import Attitude, Position
from geomosaic.survey.tagged_place import tagged_place
from geomosaic.survey.xmp import Xmp, number

_FLOAT = sourced(range(32, 50), "RtkFlag", "floating point solution", "DJI Matrice 4 Series, User Manual")
_FIXED = sourced(50, "RtkFlag", "solution with fixed ambiguities", "DJI Matrice 4 Series, User Manual")
_NONE = ATTITUDE["none"]
UNKNOWN_ATTITUDE = Attitude(None, None, None, _NONE.sd_yaw_deg, _NONE.sd_tilt_deg, "none")


@dataclass(frozen=True)
class OnboardHeights:
    """A position's heights with what is doubtful about them."""

    height_m: float | None
    above_ground_m: float | None
    datum_unknown: bool
    above_take_off: bool


def onboard_heights(exif: Exif, xmp: Xmp) -> OnboardHeights:
    """Absolute height (datum as the drone has it) and height above ground or take-off."""
    by_rtk = xmp.get("drone-dji:AltitudeType", "").lower() == "rtkalt"
    rtk = by_rtk or number(xmp, "drone-dji:RtkFlag") == _FIXED
    height = number(xmp, "drone-dji:AbsoluteAltitude", "sensefly:AbsoluteAltitude")
    if height is None:
        height = exif.altitude_m
    ground = number(
        xmp,
        "sensefly:HeightAboveGround",
        "sensefly:AboveGroundAltitude",
        "Camera:AboveGroundAltitude",
        "Camera:HeightAboveGround",
        "drone-parrot:GroundDistance",
    )
    take_off = number(
        xmp, "drone-dji:RelativeAltitude", "drone-parrot:RelativeAltitude", "FLIR:MAVRelativeAltitude"
    )
    above = ground if ground is not None else take_off
    if above is not None and above <= 1.0:  # written as 0 by receivers that don't know
        above = None
    return OnboardHeights(height, above, height is not None and not rtk, above is not None and ground is None)


def platform_of(header: FrameHeader) -> str:
    """Serial number of the drone, or of its camera; empty where no tag reports one."""
    xmp = header.xmp or {}
    drone = xmp.get("drone-dji:DroneSerialNumber") or xmp.get("drone-dji:CameraSerialNumber", "")
    return drone or header.exif.serial


def onboard_position(exif: Exif, xmp: Xmp) -> Position | None:
    """Where the drone was; None without a position.

    The heights go in as they are; `onboard_heights` says what is known of them.
    """
    place = tagged_place(exif, xmp)
    if place is None:
        return None
    heights = onboard_heights(exif, xmp)
    known = (place.lon_deg, place.lat_deg, heights.height_m, heights.above_ground_m)
    position = Position(*known, *_position_accuracy(exif, xmp))
    return replace(position, datum_stated=not heights.datum_unknown)


def rtk_source(flag: float | None) -> str:
    """The source of `accuracy.POSITION` by DJI's quality of a fix (RtkFlag; Q in Timestamp.MRK)."""
    return "rtk-fixed" if flag == _FIXED else "rtk-float" if flag in _FLOAT else "exif"


def _position_accuracy(exif: Exif, xmp: Xmp) -> tuple[float, float, float, str]:
    """Standard deviations east, north and up, and where they come from."""
    source = rtk_source(number(xmp, "drone-dji:RtkFlag"))
    if source != "exif":
        stated = [number(xmp, f"drone-dji:RtkStd{axis}") for axis in ("Lon", "Lat", "Hgt")]
    else:
        horizontal = number(xmp, "Camera:GPSXYAccuracy") or exif.position_error_m
        stated = [horizontal, horizontal, number(xmp, "Camera:GPSZAccuracy")]
    default = POSITION[source]
    east, north, up = (
        max(s, floor) if s is not None and s > 0.0 else usual
        for s, floor, usual in zip(
            stated,
            (RTK_SD_FLOOR_M[0], *RTK_SD_FLOOR_M),
            (default.sd_horizontal_m, default.sd_horizontal_m, default.sd_vertical_m),
            strict=True,
        )
    )
    return east, north, up, source


def onboard_attitude(exif: Exif, xmp: Xmp) -> Attitude:
    """How the camera was turned, as body angles (`Attitude`).

    The gimbal's angles are the camera's own and are never mixed with the aircraft's. DJI's maker note has
    them too, for files whose XMP a program rewrote. Where there are only the aircraft's, they are taken with
    wide sigmas (sources `dji-flight`, `mavlink`). Three angles of exactly 0 are a field that was never filled
    (DJI's Mini, FLIR's Vue Pro R). Makers differ. DJI and Parrot write gimbal angles (pitch -90 at the
    nadir). Pix4D's `Camera:` angles are a body's (pitch 0 at the nadir), but a pitch nearer to -90 than to 0
    is a gimbal's there too. senseFly's `Camera:Roll` has the opposite sign (as OpenDroneMap found).
    """
    for source, prefix in (("dji-gimbal", "drone-dji:Gimbal"), ("parrot-camera", "drone-parrot:Camera")):
        yaw, pitch, roll = (number(xmp, f"{prefix}{axis}Degree") for axis in ("Yaw", "Pitch", "Roll"))
        if pitch is not None and any((yaw, pitch, roll)):
            return _from_gimbal(yaw, pitch, roll, source)
    yaw, pitch, roll = (number(xmp, f"Camera:{axis}") for axis in ("Yaw", "Pitch", "Roll"))
    if any((yaw, pitch, roll)):
        if pitch is not None and abs(pitch + 90.0) < 45.0:
            return _from_gimbal(yaw, pitch, roll, "parrot-camera")
        maker = "sensefly" if "sensefly" in exif.make.lower() else "xmp-camera"
        sign = -1.0 if maker == "sensefly" and roll else 1.0
        return _attitude(yaw, pitch, None if roll is None else sign * roll, maker)
    yaw = number(xmp, "sensefly:Heading", "sensefly:YawAngle")
    pitch, roll = number(xmp, "sensefly:PitchAngle"), number(xmp, "sensefly:RollAngle")
    if pitch is not None or yaw is not None:
        return _attitude(yaw, pitch, roll, "sensefly")
    if exif.gimbal_deg is not None and any(exif.gimbal_deg):
        return _from_gimbal(*exif.gimbal_deg, "dji-gimbal")
    for source, name in (("dji-flight", "drone-dji:Flight{}Degree"), ("mavlink", "FLIR:MAV{}")):
        yaw, pitch, roll = (number(xmp, name.format(axis)) for axis in ("Yaw", "Pitch", "Roll"))
        if pitch is not None or yaw is not None:
            return _attitude(yaw, pitch, roll, source)
    return UNKNOWN_ATTITUDE


def body_from_gimbal(yaw_deg: ArrayLike, pitch_deg: ArrayLike, roll_deg: ArrayLike) -> Floats:
    """Body yaw, pitch, roll (degrees, (..., 3)) of a gimbal's; of unknown ones (NaN) the yaw stays so."""
    yaw, pitch, roll = (np.radians(np.asarray(a, dtype=np.float64)) for a in (yaw_deg, pitch_deg, roll_deg))
    rotation = Rotation.from_gimbal(np.nan_to_num(yaw), np.nan_to_num(pitch), np.nan_to_num(roll))
    body = np.degrees(np.stack(rotation.yaw_pitch_roll(), axis=-1))
    body[..., 0] = np.where(np.isnan(yaw), np.nan, body[..., 0] % 360.0)
    return np.asarray(body)


def _from_gimbal(yaw: float | None, pitch: float, roll: float | None, source: str) -> Attitude:
    known = [math.nan if angle is None else angle for angle in (yaw, pitch, roll)]
    turned, *tilts = (float(angle) for angle in body_from_gimbal(*known))
    return _attitude(None if yaw is None else turned, tilts[0], tilts[1], source)


def _attitude(yaw: float | None, pitch: float | None, roll: float | None, source: str) -> Attitude:
    known, unknown = ATTITUDE[source], _NONE
    return Attitude(
        None if yaw is None else yaw % 360.0,
        pitch,
        roll,
        unknown.sd_yaw_deg if yaw is None else known.sd_yaw_deg,
        unknown.sd_tilt_deg if pitch is None or roll is None else known.sd_tilt_deg,
        source,
    )
