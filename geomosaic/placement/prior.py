"""Prior poses: a survey's positions and attitudes brought into the work frame."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from geomosaic.arrays import Bools, Floats
from geomosaic.camera.exterior import Poses, Turns
from geomosaic.camera.rotation import Rotation
from geomosaic.constants import tuned
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m
from geomosaic.geodesy.local import LocalFrame
from geomosaic.placement.graph import HOVER, flight_lines, usual_step_m
from geomosaic.placement.heights import FrameHeights, or_nan
from geomosaic.placement.velocity import velocities_m_per_s
from geomosaic.survey.accuracy import ATTITUDE, POSITION
from geomosaic.survey.model import Survey

COURSE_YAW_SD_DEG = tuned(20.0, "deg", "of a heading by course: less pulls at crosswind; more ignores it")
_STANDS_M = tuned(0.3, "m", "from frame to frame: less is a receiver's noise; more loses the lowest flights")
YAW_LIES_DEG = tuned(8.0, "degrees", "of a wrong heading: compasses are off by as much near motors")


def heading_limits_rad(poses: Poses) -> Floats:
    """By how much each frame's heading (n,) may be off before it is called wrong: four deviations, or what
    nobody minds."""
    return heading_limit_rad(poses.rotations_sd_rad[:, 2])


def heading_limit_rad(sd_rad: Floats) -> Floats:
    """The same by the headings' deviations, (n,)."""
    return np.fmax(np.radians(YAW_LIES_DEG), 4.0 * sd_rad)


def heading_assumed(poses: Poses) -> Bools:
    """Frames (n,) whose heading nobody observed: taken from the course, or from nowhere."""
    return np.asarray(poses.rotations_sd_rad[:, 2] >= np.radians(COURSE_YAW_SD_DEG) - 1e-9)


def tilt_assumed(poses: Poses) -> Bools:
    """Frames (n,) whose tilt nobody observed: the camera is taken to look down."""
    return np.asarray(poses.rotations_sd_rad[:, :2].min(axis=1) >= np.radians(ATTITUDE["none"].sd_tilt_deg))


def position_assumed(poses: Poses) -> Bools:
    """Frames (n,) whose position nobody observed."""
    return np.asarray(poses.positions_sd_m[:, :2].min(axis=1) >= POSITION["none"].sd_horizontal_m)


def rigorous(work_frame: LocalFrame, lon_lat_height: Floats) -> tuple[Floats, Floats]:
    """Positions (n, 3) by ECEF, and the rotations (n, 3, 3) from each point's own axes."""
    lon, lat, height = lon_lat_height.T
    return work_frame.enu_from_geodetic(lon, lat, height), work_frame.enu_from_local_rotation(lon, lat)


def mid_latitude(work_frame: LocalFrame, lon_lat_height: Floats) -> tuple[Floats, Floats]:
    """The paper's plane map: its equation 4 from the work frame's origin, no Earth curvature."""
    lon, lat, height = lon_lat_height.T
    en = mid_latitude_offset_m(work_frame.lon_deg, work_frame.lat_deg, lon, lat)
    up = height - work_frame.height_ellipsoidal_m
    return np.column_stack([en, up]), np.broadcast_to(np.eye(3), (len(lon), 3, 3))


FORMULAS: dict[str, Callable[[LocalFrame, Floats], tuple[Floats, Floats]]] = {
    "rigorous": rigorous,
    "mid_latitude": mid_latitude,
}


def _body(yaw_deg: Floats, pitch_deg: Floats, roll_deg: Floats) -> Rotation:
    return Rotation.from_yaw_pitch_roll(*np.radians([yaw_deg, pitch_deg, roll_deg]))


def _paper(yaw_deg: Floats, pitch_deg: Floats, roll_deg: Floats) -> Rotation:
    return Rotation.from_phi_omega_kappa(*np.radians([pitch_deg, roll_deg, -yaw_deg]))


ATTITUDES: dict[str, Callable[[Floats, Floats, Floats], Rotation]] = {
    "yaw_pitch_roll": _body,
    "phi_omega_kappa": _paper,
}


def courses_deg(positions_m: Floats, lines: tuple[int, ...], reach: int = 1) -> Floats:
    """True course over ground at each frame (n,), by least squares through its neighbours in the same flight
    line; NaN where it has none, or hovers among them. Args: reach: how many frames before and after."""
    n = len(positions_m)
    steps_m = np.linalg.norm(np.diff(positions_m[:, :2], axis=0), axis=1)
    least_m = max(HOVER * usual_step_m(steps_m), _STANDS_M)
    course = np.full(n, np.nan)
    frames: dict[int, list[int]] = {}
    for i, line in enumerate(lines):
        frames.setdefault(line, []).append(i)
    for at in frames.values():
        if len(at) < 2:
            continue
        for k, i in enumerate(at):
            near = np.arange(max(k - reach, 0), min(k + reach + 1, len(at)))
            away = near - near.mean()
            d = away @ positions_m[[at[j] for j in near], :2] / (away @ away)
            course[i] = np.degrees(np.arctan2(d[0], d[1])) if np.hypot(*d) > least_m else np.nan
    return course


def smooth_courses_deg(positions_m: Floats) -> Floats:
    """The same through two frames before and after, so that positions good to a twentieth of their spacing
    leave two degrees; lines are found by the positions."""
    return courses_deg(positions_m, flight_lines(positions_m), reach=2)


def prior_poses(
    survey: Survey,
    heights: FrameHeights,
    lines: tuple[int, ...],
    formula: str = "rigorous",
    attitude: str = "yaw_pitch_roll",
) -> Poses:
    """Poses of all frames from their observed positions and attitudes.

    An unknown tilt is taken as nadir, an unknown yaw as the course of the flight line; their standard
    deviations say how little that is worth (COURSE_YAW_SD_DEG, `survey.accuracy.ATTITUDE`).

    Args: lines: each frame's flight line; formula, attitude: keys of `FORMULAS` and `ATTITUDES`.
    """
    frames = survey.frames
    llh = np.array(
        [[f.position.lon_deg, f.position.lat_deg, h] for f, h in zip(frames, heights.m, strict=True)]
    )
    positions, work_from_local = FORMULAS[formula](survey.work_frame, llh)
    yaw = np.array([or_nan(f.attitude.yaw_deg) for f in frames])
    sd_yaw = np.array([f.attitude.sd_yaw_deg for f in frames])
    unknown = np.isnan(yaw)
    course = np.where(survey.located, courses_deg(positions, lines), np.nan)
    sd_yaw[unknown] = np.where(np.isnan(course), ATTITUDE["none"].sd_yaw_deg, COURSE_YAW_SD_DEG)[unknown]
    yaw = np.where(unknown, np.nan_to_num(course), yaw)
    pitch, roll = (
        np.array([getattr(f.attitude, angle) or 0.0 for f in frames]) for angle in ("pitch_deg", "roll_deg")
    )
    local = ATTITUDES[attitude](yaw, pitch, roll).matrix
    velocities = velocities_m_per_s(positions, survey.clock_times_s)
    for i in (i for i, f in enumerate(frames) if f.velocity_m_per_s is not None):
        velocities[i] = work_from_local[i] @ frames[i].velocity_m_per_s
    sd_tilt = np.array([f.attitude.sd_tilt_deg for f in frames])
    return Poses(
        positions_m=positions,
        rotations=work_from_local @ local,
        positions_sd_m=np.column_stack(
            [[[f.position.sd_east_m, f.position.sd_north_m] for f in frames], heights.sd_m]
        ),
        rotations_sd_rad=np.radians(np.column_stack([sd_tilt, sd_tilt, sd_yaw])),
        velocities_m_per_s=velocities,
        turns=_turns(survey),
    )


def _turns(survey: Survey) -> Turns | None:
    """Those of all frames, over one span; 0 for frames without."""
    known = [f.turns for f in survey.frames if f.turns is not None]
    if not known:
        return None
    span_s, times = max(t.span_s for t in known), max(len(t.rad) for t in known)
    none = np.zeros((times, 3))
    tables = [none if f.turns is None else f.turns.tabled(span_s, times).rad for f in survey.frames]
    until_s = [np.nan if f.turns is None else float(f.turns.recorded_until_s) for f in survey.frames]
    return Turns(span_s, np.stack(tables), np.array(until_s))
