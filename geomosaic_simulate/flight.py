"""The flight as it was, and what the platform says of it."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources

import numpy as np

from geomosaic.arrays import Bools, Floats, Ints64
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import Rotation
from geomosaic.geodesy.local import LocalFrame
from geomosaic_simulate.paths import course_of
from geomosaic_simulate.plan import SurveyPlan

START_S = datetime(2024, 6, 12, 9, 30, tzinfo=UTC).timestamp()
_BATTERY_S = 600.0
_EACH_S = 3.0
_CLIMB_M_PER_S = 2.0
_CLIMB_TO = 0.7
_OBLIQUE_DEG, _HORIZON_DEG = (35.0, 60.0), (75.0, 88.0)
_GROUND_TAG_SD_M = 0.5
_WAVES = 64
"""Whose sum is as good as Gaussian."""


@dataclass(frozen=True)
class Flight:
    """The true flight of n frames.

    lon_lat_height: (n, 3) geodetic; yaw_pitch_roll_deg: (n, 3) body angles, see `Attitude`, against the
    north and the vertical of each frame; poses: the same in the work frame; time_s: (n,) since 1970;
    line: (n,) number of the flight line;
    velocity_m_per_s: (n, 3) in the work frame, along the planned course, of the wander about it and of
    updrafts too short to show in places; role: (n,) `survey`, or `take_off`,
    `landing`, `oblique` or `horizon` of frames that belong in no map; battery:
    (n,) from 0.
    """

    work_frame: LocalFrame
    lon_lat_height: Floats
    yaw_pitch_roll_deg: Floats
    poses: Poses
    time_s: Floats
    line: Ints64
    velocity_m_per_s: Floats
    role: tuple[str, ...]
    battery: Ints64


@dataclass(frozen=True)
class Observed:
    """What the platform says: truth plus errors, which are listed with it.

    position_errors_m: (n, 3) east, north, up; attitude_errors_deg: (n, 3) yaw, pitch, roll. Outliers and
    wrong headings are in the errors, and not in the standard deviations that the POS states.
    height_above_take_off_m: (n,) by barometer, free of what is the GPS's: bias, drift, a battery's offset.
    """

    lon_lat_height: Floats
    yaw_pitch_roll_deg: Floats
    position_errors_m: Floats
    attitude_errors_deg: Floats
    outlier: Bools
    yaw_wrong: Bools
    height_above_take_off_m: Floats


def fly(plan: SurveyPlan) -> Flight:
    """The true flight of a plan."""
    return _with_others(plan, _paper(plan) if plan.kind == "paper" else _planned(plan))


def _planned(plan: SurveyPlan) -> Flight:
    """The planned course about the plan's place, flown with wander."""
    course = course_of(plan)
    n = len(course.at_m)
    forward_m, right_m = course.at_m.T
    strayed_m, straying_m_per_s = _wander(plan, course.time_s)
    wander = plan.rng("flight").standard_normal((n, 6))
    heading = np.radians(plan.heading_deg)
    east = forward_m * np.sin(heading) + right_m * np.cos(heading) + strayed_m[:, 0]
    north = forward_m * np.cos(heading) - right_m * np.sin(heading) + strayed_m[:, 1]
    work_frame = LocalFrame(plan.lon_deg, plan.lat_deg, plan.ground_height_m)
    geodetic = work_frame.geodetic_from_enu(np.stack([east, north, np.zeros(n)], axis=-1))
    geodetic[:, 2] = plan.ground_height_m + plan.height_above_ground_m + strayed_m[:, 2]
    yaw = plan.heading_deg + course.nose_deg + plan.wander_yaw_deg * wander[:, 3]
    attitude = np.column_stack([yaw % 360.0, plan.wander_tilt_deg * wander[:, 4:]])
    ahead = heading + np.radians(course.course_deg)
    velocity = plan.speed_m_per_s * np.column_stack([np.sin(ahead), np.cos(ahead), np.zeros(n)])
    velocity += straying_m_per_s
    velocity[:, 2] += plan.updraft_m_per_s * plan.rng("updraft").standard_normal(n)
    return _flight(work_frame, geodetic, attitude, START_S + course.time_s, course.line, velocity)


def _wander(plan: SurveyPlan, time_s: Floats) -> tuple[Floats, Floats]:
    """How far the flight strays from its course, (n, 3), and how fast, (n, 3). The path is a smooth
    stationary Gaussian process by random frequencies (Rahimi and Recht 2007, section 3). Its correlation
    falls to exp(-1/2) in `wander_s`. Places and velocities are of this one path."""
    rng = plan.rng("wander")
    rate = rng.standard_normal((_WAVES, 3)) / plan.wander_s
    phase = rate * time_s[:, None, None] + rng.uniform(0.0, 2.0 * np.pi, (_WAVES, 3))
    size = plan.wander_m * np.sqrt(2.0 / _WAVES)
    return size * np.cos(phase).sum(axis=1), -size * (rate * np.sin(phase)).sum(axis=1)


def _with_others(plan: SurveyPlan, flight: Flight) -> Flight:
    """The flight with the second battery's pause, and with frames at take-off, of the view and at landing.

    On the way up and down frames are taken straight below, above the first and below the last place. Oblique
    frames and those of the horizon come after the survey, from its places, in any direction.
    """
    n = len(flight.poses)
    second = (np.arange(n) >= (n + 1) // 2) & bool(plan.battery_offset_m or plan.battery_height_offset_m)
    rng = plan.rng("others")
    view = plan.oblique_frames + plan.horizon_frames
    at = np.concatenate(
        [
            np.zeros(plan.take_off_frames, dtype=np.int64),
            np.arange(n),
            rng.integers(0, n, view),
            np.full(plan.landing_frames, n - 1),
        ]
    )
    role = (
        *["take_off"] * plan.take_off_frames,
        *["survey"] * n,
        *["oblique"] * plan.oblique_frames,
        *["horizon"] * plan.horizon_frames,
        *["landing"] * plan.landing_frames,
    )
    if len(at) == n and not second.any():
        return flight
    geodetic, attitude = flight.lon_lat_height[at], flight.yaw_pitch_roll_deg[at]
    velocity, line = flight.velocity_m_per_s[at], flight.line[at]
    for name, sign in (("take_off", 1.0), ("landing", -1.0)):
        mine = np.flatnonzero(np.array(role) == name)
        share = _CLIMB_TO * (np.arange(len(mine)) + 0.5) / max(len(mine), 1)
        above = geodetic[mine, 2] - plan.ground_height_m
        geodetic[mine, 2] = plan.ground_height_m + above * share[:: int(sign)]
        velocity[mine] = [0.0, 0.0, sign * _CLIMB_M_PER_S]
    for name, tilts_deg in (("oblique", _OBLIQUE_DEG), ("horizon", _HORIZON_DEG)):
        mine = np.flatnonzero(np.array(role) == name)
        attitude[mine, 0] = rng.uniform(0.0, 360.0, len(mine))
        attitude[mine, 1] = rng.uniform(*tilts_deg, len(mine))
        velocity[mine] = 0.0
    line[np.array(role) != "survey"] = -1
    pause = np.where(second, _BATTERY_S, 0.0)
    step = _EACH_S * np.arange(1, view + plan.landing_frames + 1)
    before = _EACH_S * np.arange(plan.take_off_frames, 0, -1)
    time_s = flight.time_s + pause
    time_s = np.concatenate([time_s[0] - before, time_s, time_s[-1] + step])
    battery = np.concatenate([np.zeros(len(before)), second, np.full(len(step), second[-1])]).astype(np.int64)
    return _flight(flight.work_frame, geodetic, attitude, time_s, line, velocity, role, battery)


def paper_table() -> list[dict[str, float]]:
    """Table 2 of Yue et al. 2021 (IRLA20200529), one dict a frame."""
    with resources.files("geomosaic_simulate").joinpath("paper_table2.csv").open(encoding="ascii") as f:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(f)]


def _paper(plan: SurveyPlan) -> Flight:
    """The nine frames of table 2: pitch is phi, roll omega, and kappa minus the heading (`Rotation`).

    As in the paper's equation 1 the tilts are about west and north and not about the platform's axes: 3
    degrees of phi look 77 m to the north. The POS that is written holds the same attitude as a body's
    yaw, pitch and roll.
    """
    table = paper_table()
    col = {key: np.array([row[key] for row in table]) for key in table[0]}
    rotation = Rotation.from_phi_omega_kappa(
        np.radians(col["pitch_deg"]), np.radians(col["roll_deg"]), -np.radians(col["heading_deg"])
    )
    attitude = np.degrees(np.column_stack(rotation.yaw_pitch_roll()))
    attitude[:, 0] %= 360.0
    geodetic = np.column_stack([col["lon_deg"], col["lat_deg"], col["height_m"] + plan.ground_height_m])
    middle = geodetic.mean(axis=0)
    work_frame = LocalFrame(float(middle[0]), float(middle[1]), plan.ground_height_m)
    flown = np.linalg.norm(np.diff(work_frame.enu_from_geodetic(*geodetic.T), axis=0), axis=1)
    time_s = START_S + np.concatenate([[0.0], np.cumsum(flown / plan.speed_m_per_s)])
    ahead = np.gradient(work_frame.enu_from_geodetic(*geodetic.T), axis=0) * [1.0, 1.0, 0.0]
    velocity = plan.speed_m_per_s * ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    return _flight(work_frame, geodetic, attitude, time_s, np.zeros(len(table), dtype=np.int64), velocity)


def _flight(
    work_frame: LocalFrame,
    geodetic: Floats,
    attitude_deg: Floats,
    time_s: Floats,
    line: Ints64,
    velocity_m_per_s: Floats,
    role: tuple[str, ...] = (),
    battery: Ints64 | None = None,
) -> Flight:
    n = len(geodetic)
    role, battery = role or ("survey",) * n, np.zeros(n, dtype=np.int64) if battery is None else battery
    poses = Poses(
        work_frame.enu_from_geodetic(*geodetic.T),
        rotations_in(work_frame, geodetic, attitude_deg),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
    )
    return Flight(work_frame, geodetic, attitude_deg, poses, time_s, line, velocity_m_per_s, role, battery)


def rotations_in(work_frame: LocalFrame, geodetic: Floats, attitude_deg: Floats) -> Floats:
    """Rotations (n, 3, 3) in the work frame of body angles against each place's north and vertical."""
    local = Rotation.from_yaw_pitch_roll(*np.radians(attitude_deg).T).matrix
    return np.asarray(work_frame.enu_from_local_rotation(geodetic[:, 0], geodetic[:, 1]) @ local)


def position_bias(plan: SurveyPlan) -> Floats:
    """East, north, up (3,) of the error that all positions share; its direction is the seed's."""
    direction = plan.rng("bias").uniform(0.0, 2.0 * np.pi)
    east, north = plan.position_bias_m * np.array([np.sin(direction), np.cos(direction)])
    return np.array([east, north, plan.height_bias_m])


def observe(plan: SurveyPlan, flight: Flight) -> Observed:
    """The platform's position and attitude: truth, noise, lag, and whatever else is to be wrong."""
    n = len(flight.poses)
    noise = plan.rng("pos").standard_normal((n, 6))
    errors_m = noise[:, :3] * [plan.position_sd_m, plan.position_sd_m, plan.height_sd_m]
    errors_deg = noise[:, 3:] * [plan.yaw_sd_deg, plan.tilt_sd_deg, plan.tilt_sd_deg]
    errors_m -= plan.gps_lag_s * flight.velocity_m_per_s
    bias_m = position_bias(plan)
    since_s = flight.time_s - flight.time_s[0]
    offset_m = bias_m[2] + plan.height_drift_m * since_s / max(float(since_s[-1]), 1.0)
    offset_m = offset_m + plan.battery_height_offset_m * flight.battery
    errors_m += np.column_stack([np.tile(bias_m[:2], (n, 1)), offset_m])
    errors_m[:, :2] += flight.battery[:, None] * battery_offset(plan)
    rng = plan.rng("outliers")
    outlier, yaw_wrong = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    outlier[rng.permutation(n)[: plan.gps_outliers]] = True
    direction = rng.uniform(0.0, 2.0 * np.pi, n)
    away_m = plan.gps_outlier_m * np.column_stack([np.sin(direction), np.cos(direction)])
    errors_m[:, :2] += np.where(outlier[:, None], away_m, 0.0)
    yaw_wrong[rng.permutation(n)[: round(plan.yaw_wrong_share * n)]] = True
    errors_deg[:, 0] += np.where(yaw_wrong, rng.uniform(30.0, 330.0, n), 0.0)
    stale = flight.line == plan.stale_yaw_line - 1
    if plan.stale_yaw_line and stale.any():
        true_deg = flight.yaw_pitch_roll_deg[:, 0]
        last = int(np.flatnonzero(stale)[0]) - 1
        errors_deg[stale, 0] = true_deg[last] + errors_deg[last, 0] - true_deg[stale]
        yaw_wrong |= stale

    geodetic = flight.work_frame.geodetic_from_enu(flight.poses.positions_m + errors_m)
    above_m = geodetic[:, 2] - offset_m - plan.ground_height_m - plan.take_off_up_m
    reported_m = _altitudes(plan, geodetic[:, 2], above_m)
    errors_m[:, 2] += reported_m - geodetic[:, 2]
    geodetic[:, 2] = reported_m
    attitude = flight.yaw_pitch_roll_deg + errors_deg
    attitude[:, 0] %= 360.0
    return Observed(geodetic, attitude, errors_m, errors_deg, outlier, yaw_wrong, above_m)


def battery_offset(plan: SurveyPlan) -> Floats:
    """East and north (2,) by which positions of the second battery are off those of the first."""
    direction = plan.rng("battery").uniform(0.0, 2.0 * np.pi)
    return plan.battery_offset_m * np.array([np.sin(direction), np.cos(direction)])


def _altitudes(plan: SurveyPlan, height_m: Floats, above_take_off_m: Floats) -> Floats:
    """What the tags give as altitude: the height flown, or something else that passes for it; in steps."""
    noise = plan.rng("altitude").standard_normal(len(height_m))
    altitude_m = {
        "flown": height_m,
        "take_off": above_take_off_m,
        "constant": np.full(len(height_m), height_m[0]),
        "ground": plan.ground_height_m + _GROUND_TAG_SD_M * noise,
    }[plan.altitude]
    step = plan.altitude_step_m
    return np.asarray(np.round(altitude_m / step) * step if step else altitude_m)
