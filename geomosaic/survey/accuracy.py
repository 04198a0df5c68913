"""Default standard deviations of observations, one table for all sources, each with its reason.

They stand in where a file states none. A wrong sigma spoils a weighted solution as surely as a wrong
value, so each default is on the careful side of what the source is known to reach.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from geomosaic.constants import tuned


@dataclass(frozen=True)
class PositionAccuracy:
    """Standard deviations of a position per axis, in metres."""

    sd_horizontal_m: float
    sd_vertical_m: float
    reason: str


@dataclass(frozen=True)
class AttitudeAccuracy:
    """Standard deviations of the heading, and of the tilt about each horizontal axis, in degrees."""

    sd_yaw_deg: float
    sd_tilt_deg: float
    reason: str


@dataclass(frozen=True)
class LensAccuracy:
    """Standard deviation of a focal length as a part of itself, or of what a lens moves points at the frame's
    corner as a part of its radius."""

    sd_relative: float
    reason: str


POSITION: Final = {
    "exif": PositionAccuracy(5.0, 15.0, "code GNSS; EXIF's altitude has no stated datum"),
    "rtk-fixed": PositionAccuracy(0.03, 0.05, "fixed ambiguities; only where the drone states no sigma"),
    "rtk-float": PositionAccuracy(0.5, 1.0, "float ambiguities; only where the drone states no sigma"),
    "pos": PositionAccuracy(2.0, 3.0, "a POS file without sigmas may be anything from PPK to a handheld"),
    "none": PositionAccuracy(1e5, 1e5, "nothing observed: anywhere"),
}

ATTITUDE: Final = {
    "dji-gimbal": AttitudeAccuracy(3.0, 0.5, "stabilised gimbal; its yaw comes from the compass"),
    "dji-flight": AttitudeAccuracy(5.0, 5.0, "the aircraft's attitude, not the camera's"),
    "mavlink": AttitudeAccuracy(5.0, 5.0, "the aircraft's attitude by its autopilot, not the camera's"),
    "parrot-camera": AttitudeAccuracy(3.0, 1.0, "camera attitude from the autopilot"),
    "sensefly": AttitudeAccuracy(5.0, 3.0, "autopilot of a light fixed wing, camera not stabilised"),
    "xmp-camera": AttitudeAccuracy(5.0, 3.0, "small IMU next to the camera"),
    "pos-yaw-pitch-roll": AttitudeAccuracy(2.0, 1.0, "a POS file without sigmas"),
    "pos-omega-phi-kappa": AttitudeAccuracy(0.5, 0.5, "from an adjustment or a survey-grade IMU"),
    "none": AttitudeAccuracy(180.0, 10.0, "nothing observed: taken to look down, any heading"),
}

FOCAL_LENGTH: Final = {
    "camera-file": LensAccuracy(0.005, "calibrated, but maybe on another day or block"),
    "dji-dewarp": LensAccuracy(0.005, "the maker's calibration of this camera, in the XMP"),
    "xmp-perspective": LensAccuracy(0.005, "the maker's calibration of this camera, in Pix4D's tags"),
    "xmp-fisheye": LensAccuracy(0.005, "the same, of a fisheye lens"),
    "dji-calibrated": LensAccuracy(0.01, "the maker's number for the model, to the digit its design's"),
    "focal-plane": LensAccuracy(0.02, "nominal focal length and sensor size"),
    "sensor-table": LensAccuracy(0.02, "nominal focal length and sensor size"),
    "sensor-pitch": LensAccuracy(0.05, "published pixel pitch, exact; focal length as published or tagged"),
    "exif-35mm": LensAccuracy(0.02, "besides the rounding to whole millimetres, which is added"),
    "action-camera": LensAccuracy(0.2, "one lens, several modes: wide 0.47, medium 0.63 of the width"),
    "assumed": LensAccuracy(0.5, "nothing reported: cameras in use have 0.5 to 1.6 of the longer side"),
    "contradicting": LensAccuracy(0.5, "at least; all that are reported lie within one deviation"),
}

MAKERS_DISTORTION: Final = LensAccuracy(
    0.002, "calibrated in the works: focus, warmth and landings since then move a corner by some pixels"
)

RTK_SD_FLOOR_M = tuned((0.02, 0.03), "m, plan and height", "lever arm and delay: less outweighs the images")

CONTROL: Final = PositionAccuracy(0.03, 0.05, "an RTK rover on the ground")
