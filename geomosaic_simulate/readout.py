"""How the rows of a frame are read one after the other while the camera moves and shakes."""

from __future__ import annotations

import base64
import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation as Turn

from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic_simulate.flight import Flight
from geomosaic_simulate.plan import SurveyPlan

GYROSCOPE_FROM_CAMERA = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Angular rates in the tag's axes from those about camera axes. The tag's axes are forward, right and down,
as a Sequoia writes them. Camera axes (`camera.rotation.Rotation`) are x to the image's right, y to its top, z
against the view; right-handed."""
GYROSCOPE_DELAY_S = 0.0425
"""By how much the rates that are written lag, a Sequoia's."""
GYROSCOPE_HZ = 1000
_RECORD = struct.Struct("<Qfff4x")
_SPREAD = 0.3
_ROUNDS = 6
_NONE = np.zeros(3)


@dataclass(frozen=True)
class FrameReadout:
    """The time that a frame takes to be read, from its first row to its last, and what happens meanwhile.

    velocity_m_per_s (3,): of the camera, in the work frame. The camera shakes about each of its axes with
    the rate `rate sin(2 pi frequency t + phase)`, t counted from when the middle row is read, whose pose is
    the frame's.
    """

    time_s: float = 0.0
    velocity_m_per_s: Floats = field(default_factory=_NONE.copy)
    rate_rad_per_s: Floats = field(default_factory=_NONE.copy)
    frequency_hz: Floats = field(default_factory=lambda: np.ones(3))
    phase_rad: Floats = field(default_factory=_NONE.copy)

    @property
    def shakes(self) -> bool:
        """Whether the camera turns while the rows are read."""
        return bool(self.time_s and np.any(self.rate_rad_per_s))

    def after_s(self, share: ArrayLike) -> Floats:
        """When a row is read, counted from the middle row: rows by their share of the height, from 0 to 1."""
        return self.time_s * (np.asarray(share, dtype=np.float64) - 0.5)

    def rates_rad_per_s(self, after_s: ArrayLike) -> Floats:
        """Angular rates about the camera's axes (..., 3)."""
        t = np.asarray(after_s, dtype=np.float64)[..., None]
        return np.asarray(self.rate_rad_per_s * np.sin(2.0 * np.pi * self.frequency_hz * t + self.phase_rad))

    def turned_rad(self, after_s: ArrayLike) -> Floats:
        """By how much the camera has turned about its axes since the middle row (..., 3): rates summed up."""
        t = np.asarray(after_s, dtype=np.float64)[..., None]
        round_rad_per_s = 2.0 * np.pi * self.frequency_hz
        angle = np.cos(self.phase_rad) - np.cos(round_rad_per_s * t + self.phase_rad)
        return np.asarray(self.rate_rad_per_s / round_rad_per_s * angle)

    def rays(self, camera: Camera, pose: Pose, image_px: Floats) -> tuple[Floats, Floats]:
        """From where and in which direction (work frame, (..., 3)) cols and rows (..., 2) were seen."""
        after_s = self.after_s(image_px[..., 1] / camera.height_px)
        origin = pose.position_m + after_s[..., None] * self.velocity_m_per_s
        ray = camera.ray_from_image(image_px)
        if self.shakes:
            turned = Turn.from_rotvec(self.turned_rad(after_s).reshape(-1, 3))
            ray = turned.apply(ray.reshape(-1, 3)).reshape(ray.shape)
        return origin, np.asarray(ray @ pose.rotation.matrix.T)

    def image_from_ground(self, camera: Camera, pose: Pose, ground_m: Floats) -> Floats:
        """Col and row (n, 2) of points (n, 3), each seen when its own row is read. NaN where not seen."""
        px = pose.image_from_ground(camera, ground_m)
        for _ in range(_ROUNDS if self.time_s else 0):
            after_s = self.after_s(np.where(np.isnan(px[:, 1]), 0.0, px[:, 1]) / camera.height_px)
            seen = ground_m - pose.position_m - after_s[:, None] * self.velocity_m_per_s
            seen = seen @ pose.rotation.matrix
            if self.shakes:
                seen = Turn.from_rotvec(self.turned_rad(after_s)).inv().apply(seen)
            px = camera.image_from_camera(seen)
        return px

    def moved_px(self, camera: Camera, pixel_m: float) -> float:
        """At most how far a point's image is from where it would be if all rows were read with the middle."""
        course = 0.5 * self.time_s * float(np.linalg.norm(self.velocity_m_per_s)) / pixel_m
        turn = float(np.abs(self.turned_rad(self.after_s(np.linspace(0.0, 1.0, 65)))).max())
        return course + turn * 2.0 * camera.focal_length_px


def readout_of(plan: SurveyPlan, flight: Flight, i: int) -> FrameReadout:
    """The readout of frame i: amplitudes and frequencies vary by some 30 %, phases are any."""
    rng = plan.rng("vibration", i)
    spread = 1.0 + _SPREAD * rng.uniform(-1.0, 1.0, (2, 3))
    return FrameReadout(
        plan.rolling_shutter_s,
        flight.velocity_m_per_s[i],
        np.radians(plan.vibration_deg_per_s) * spread[0],
        plan.vibration_hz * spread[1],
        rng.uniform(0.0, 2.0 * np.pi, 3),
    )


def gyroscope_tag(plan: SurveyPlan, readout: FrameReadout, first_row_us: int, i: int) -> str:
    """Base64 of 24-byte records, little endian, at 1 kHz from the first row to the last: uint64 microseconds,
    three float32 rad/s in the gyroscope's axes, 4 bytes more."""
    count = int(readout.time_s * GYROSCOPE_HZ) + 1
    since_s = np.arange(count) / GYROSCOPE_HZ
    since_s -= 0.5 * readout.time_s + GYROSCOPE_DELAY_S
    rates = readout.rates_rad_per_s(since_s) @ GYROSCOPE_FROM_CAMERA.T
    noise = plan.rng("gyroscope", i).standard_normal(rates.shape)
    rates = rates + np.radians(plan.gyroscope_sd_deg_per_s) * noise
    step_us = 1_000_000 // GYROSCOPE_HZ
    records = b"".join(_RECORD.pack(first_row_us + k * step_us, *rate) for k, rate in enumerate(rates))
    return base64.b64encode(records).decode()
