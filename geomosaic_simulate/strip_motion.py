"""The camera of a simulated scene: its orbit, how its attitude drifts and jitters, where its CCDs look."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from geomosaic.arrays import Floats
from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.errors import FileError, InputError
from geomosaic.geodesy.ellipsoid import meridian_radius_m, prime_vertical_radius_m
from geomosaic.geodesy.local import ecef_from_geodetic
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic_simulate.strip_plan import JITTER_HZ, StripPlan

_ORBIT_STEP_S = 0.25
_SPARE_S = 0.5
_ACROSS = 0.6  # jitter across the track, of that along it
_SLOW_PERIODS_S = (7.0, 13.0, 29.0)
_ERROR_PERIOD_S = 2.0


def scene_crs(plan: StripPlan) -> str:
    """The map of the scene: oblique Mercator on the track, x as columns grow, y against the lines.

    The track is its y axis, flown towards -y, so that a north-up image of this map looks like the strips.
    It is true to scale at the plan's mean height.
    """
    back_deg = (plan.course_deg + 180.0) % 360.0
    lat, azimuth = np.radians(plan.lat_deg), np.radians(back_deg)
    bend = np.cos(azimuth) ** 2 / meridian_radius_m(lat) + np.sin(azimuth) ** 2 / prime_vertical_radius_m(lat)
    scale = float(1.0 + plan.ground_height_m * bend)
    return (
        f"+proj=omerc +lat_0={plan.lat_deg!r} +lonc={plan.lon_deg!r} +alpha={back_deg!r}"
        f" +gamma=0 +k_0={scale!r} +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs +type=crs"
    )


@dataclass(frozen=True, eq=False)
class Cameras:
    """The camera that took the strips, as it is and as it is reported, and the ideal one of the true scene.

    slow_rad: roll, pitch, yaw (..., 3) at times, without what is faster than some seconds.
    """

    true: Pushbroom
    reported: Pushbroom
    ideal: Pushbroom
    slow_rad: CubicSpline


def cameras_of(plan: StripPlan) -> Cameras:
    """The three cameras of a plan, all on one orbit.

    The ideal camera is one unbroken line of CCDs that looks straight down, midway between the rows, and whose
    attitude neither drifts nor jitters. What is reported differs by `attitude_bias_urad` (about each axis),
    `attitude_error_urad` (changing within seconds) and `attitude_noise_urad` (of each sample).
    """
    start, stop = -_SPARE_S, plan.lines / plan.line_rate_hz + _SPARE_S
    apart_s = 1.5 * plan.row_separation_lines / plan.line_rate_hz
    start, stop = start - apart_s, stop + apart_s
    orbit_s = np.arange(np.floor(start / _ORBIT_STEP_S), np.ceil(stop / _ORBIT_STEP_S) + 1) * _ORBIT_STEP_S
    middle_s = plan.lines / plan.line_rate_hz / 2.0
    speed = plan.ground_pixel_m * plan.line_rate_hz
    lonlat = MapProjection(scene_crs(plan)).geodetic_from_map(0.0, -speed * (orbit_s - middle_s))
    orbit = ecef_from_geodetic(lonlat[..., 0], lonlat[..., 1], plan.ground_height_m + plan.altitude_m)

    count = int(np.ceil((stop - start) * plan.attitude_hz)) + 1
    time_s = start + np.arange(count) / plan.attitude_hz
    slow = _drift_rad(plan, time_s, middle_s)
    attitude = slow + _jitter_rad(plan, time_s) + _given_rad(plan, time_s)
    forward, right = _looks(plan, middle_s)
    true = Pushbroom(plan.line_rate_hz, orbit_s, orbit, time_s, attitude, forward, right)
    error = _reported_error_rad(plan, time_s)
    reported = Pushbroom(plan.line_rate_hz, orbit_s, orbit, time_s, attitude + error, forward, right)
    half_px = (plan.ccds * plan.width_px - (plan.ccds - 1) * plan.overlap_px) / 2.0
    ideal = Pushbroom(
        plan.line_rate_hz,
        orbit_s,
        orbit,
        time_s,
        np.zeros_like(attitude),
        np.zeros((1, 3)),
        np.array([[half_px * plan.pixel_rad, -plan.pixel_rad, 0.0]]),
    )
    return Cameras(true, reported, ideal, CubicSpline(time_s, slow))


def _drift_rad(plan: StripPlan, time_s: Floats, middle_s: float) -> Floats:
    """Slow roll, pitch, yaw: rates that themselves change within 7 to 29 s, and a drift angle."""
    rng = np.random.default_rng([plan.seed, 41])
    rate = plan.drift_px_per_s * plan.pixel_rad
    out = np.zeros((time_s.size, 3))
    for axis in range(2):
        for period in _SLOW_PERIODS_S:
            phase = rng.uniform(0.0, 2.0 * np.pi)
            share = rate * period / (2.0 * np.pi) / np.sqrt(len(_SLOW_PERIODS_S) / 2.0)
            turn = 2.0 * np.pi * (time_s - middle_s) / period + phase
            out[:, axis] += share * (np.sin(turn) - np.sin(phase))
    yaw = np.radians(plan.drift_angle_deg)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    out[:, 2] = yaw * (1.0 + 0.2 * np.sin(2.0 * np.pi * (time_s - middle_s) / _SLOW_PERIODS_S[1] + phase))
    return out


def _jitter_rad(plan: StripPlan, time_s: Floats) -> Floats:
    """Roll and pitch at `JITTER_HZ`; the amplitudes are of the pitch, in ground pixels."""
    rng = np.random.default_rng([plan.seed, 42])
    out = np.zeros((time_s.size, 3))
    amplitudes = (plan.jitter_1hz_px, plan.jitter_5hz_px, plan.jitter_22hz_px)
    for frequency, amplitude in zip(JITTER_HZ, amplitudes, strict=True):
        along, across = rng.uniform(0.0, 2.0 * np.pi, 2)
        turn = 2.0 * np.pi * frequency * time_s
        out[:, 1] += amplitude * plan.pixel_rad * np.sin(turn + along)
        out[:, 0] += _ACROSS * amplitude * plan.pixel_rad * np.sin(turn + across)
    return out


def _given_rad(plan: StripPlan, time_s: Floats) -> Floats:
    """The motion of a CSV: time_s, along_px, across_px; how far the camera looks ahead and to image right.

    Straight between its lines, constant before the first and after the last.
    """
    out = np.zeros((time_s.size, 3))
    if plan.motion is None:
        return out
    try:
        rows = list(csv.reader(io.StringIO(plan.motion.read_text(encoding="utf-8-sig"))))
        if not rows or [cell.strip() for cell in rows[0]] != ["time_s", "along_px", "across_px"]:
            raise InputError(
                "its first line isn't time_s,along_px,across_px", file=plan.motion, fix="name the columns so"
            )
        table = np.array([[float(cell) for cell in row] for row in rows[1:] if row])
    except InputError:
        raise
    except OSError as error:
        raise FileError(
            (f"can't be read ({error.strerror})"), file=plan.motion, fix="give a CSV file"
        ) from error
    except (ValueError, csv.Error) as error:
        raise InputError("holds what is no number", file=plan.motion, fix="give a CSV of numbers") from error
    if table.ndim != 2 or table.shape[1] != 3 or not np.isfinite(table).all():
        raise InputError("isn't a table of three numbers a line", file=plan.motion, fix="complete it")
    if (np.diff(table[:, 0]) <= 0.0).any():
        raise InputError("its times don't rise from line to line", file=plan.motion, fix="sort it by time")
    out[:, 1] = np.interp(time_s, table[:, 0], table[:, 1]) * plan.pixel_rad
    out[:, 0] = np.interp(time_s, table[:, 0], table[:, 2]) * plan.pixel_rad
    return out


def _reported_error_rad(plan: StripPlan, time_s: Floats) -> Floats:
    """Reported minus true attitude."""
    rng = np.random.default_rng([plan.seed, 43])
    bias = plan.attitude_bias_urad * rng.choice([-1.0, 1.0], 3)
    knots_s = np.arange(time_s[0] - 3.0, time_s[-1] + 2.0 * _ERROR_PERIOD_S, _ERROR_PERIOD_S)
    slow = CubicSpline(knots_s, rng.standard_normal((knots_s.size, 3)))(time_s) * plan.attitude_error_urad
    noise = plan.attitude_noise_urad * rng.standard_normal((time_s.size, 3))
    return np.asarray((bias + slow + noise) * 1e-6)


def _looks(plan: StripPlan, middle_s: float) -> tuple[Floats, Floats]:
    """forward_tan and right_tan of the CCDs: the nominal focal plane, its mounting errors, its thermal drift.

    Columns grow to the flight's left. Mounting shifts are of each CCD, forward and across; the thermal part
    is the change within the scene.
    """
    rng = np.random.default_rng([plan.seed, 44])
    mounting = plan.mounting_px * rng.standard_normal((plan.ccds, 2))
    thermal = plan.thermal_px * rng.standard_normal((plan.ccds, 2)) / (2.0 * middle_s)
    half_px = (plan.ccds * plan.width_px - (plan.ccds - 1) * plan.overlap_px) / 2.0
    forward, right = np.zeros((plan.ccds, 3)), np.zeros((plan.ccds, 3))
    for k in range(plan.ccds):
        ahead = plan.row_separation_lines / 2.0 * (1.0 if plan.row(k) == 1 else -1.0)
        first_px = k * (plan.width_px - plan.overlap_px) - half_px
        forward[k] = ahead + mounting[k, 0] - thermal[k, 0] * middle_s, 0.0, thermal[k, 0]
        right[k] = -(first_px + mounting[k, 1] - thermal[k, 1] * middle_s), -1.0, -thermal[k, 1]
    return forward * plan.pixel_rad, right * plan.pixel_rad
