"""Where surveys are flown: lines side by side, lines crossed, a spiral, a path flown by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats, Ints64
from geomosaic_simulate.plan import SurveyPlan

_TURN_S = 20.0
_STEPS = 20
_FREE_TURN_RAD = 0.9
_FREE_NOSE_DEG = 12.0
_FREE_BASE = (0.75, 1.25)


@dataclass(frozen=True)
class Course:
    """The planned places of n frames about the survey's middle.

    at_m (n, 2): metres ahead and to the right of the first line's heading; course_deg (n,): where the flight
    goes, clockwise from that heading; nose_deg (n,): the same for the camera; line (n,); time_s (n,).
    """

    at_m: Floats
    course_deg: Floats
    nose_deg: Floats
    line: Ints64
    time_s: Floats


def course_of(plan: SurveyPlan) -> Course:
    """The planned course; the paper's flight has none."""
    return _PATHS[plan.kind](plan)


def _steps_m(plan: SurveyPlan) -> tuple[float, float]:
    """The distance between frames of a line, and between lines."""
    base = (1.0 - plan.forward_overlap) * plan.height_px * plan.ground_pixel_m
    return base, (1.0 - plan.side_overlap) * plan.width_px * plan.ground_pixel_m


def _block(plan: SurveyPlan) -> Course:
    """Lines side by side to the right of the heading, every second one flown back."""
    base, apart = _steps_m(plan)
    lines, along_n = (1 if plan.kind == "line" else plan.lines), plan.frames_per_line
    line, k = np.divmod(np.arange(lines * along_n), along_n)
    backward = (line % 2 == 1) & plan.serpentine
    k = np.where(backward, along_n - 1 - k, k)
    at = np.column_stack([(k - (along_n - 1) / 2.0) * base, (line - (lines - 1) / 2.0) * apart])
    course = np.where(backward, 180.0, 0.0)
    time_s = np.arange(len(line)) * base / plan.speed_m_per_s + line * _TURN_S
    return Course(at, course, course, line, time_s)


def _crossed(plan: SurveyPlan) -> Course:
    """A block, and the same block turned clockwise by 90 degrees about the middle."""
    once = _block(plan)
    ahead, right = once.at_m.T
    later = float(once.time_s[-1]) + 2.0 * _TURN_S
    course = np.concatenate([once.course_deg, once.course_deg + 90.0])
    return Course(
        np.concatenate([once.at_m, np.column_stack([-right, ahead])]),
        course,
        course,
        np.concatenate([once.line, once.line + plan.lines]),
        np.concatenate([once.time_s, once.time_s + later]),
    )


def _spiral(plan: SurveyPlan) -> Course:
    """Archimedes' spiral outward and clockwise, its rings as far apart as lines would be."""
    base, apart = _steps_m(plan)
    n = plan.planned_frames
    angle = np.linspace(0.0, 2.0 * np.pi * np.sqrt(2.0 * n * max(base / apart, 1.0)) + 2.0 * np.pi, 200 * n)
    radius = apart * (0.25 + angle / (2.0 * np.pi))
    path = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return _along(plan, path, base * np.arange(n, dtype=np.float64))


def _free(plan: SurveyPlan) -> Course:
    """A path that wanders about within a circle that holds the frames, turned back at its border.

    Frames are taken by hand every 0.75 to 1.25 of the base; the nose strays by some 12 degrees.
    """
    base, apart = _steps_m(plan)
    n = plan.planned_frames
    rng = plan.rng("path")
    border = 0.55 * np.sqrt(n * base * apart)
    bend = rng.uniform(-1.0, 1.0, 2 * n + 4)
    at, heading = np.array([-0.7 * border, rng.uniform(-0.5, 0.5) * border]), rng.uniform(-0.5, 0.5)
    path = [at]
    for k in range(2 * n * _STEPS):
        curve = float(np.interp(k / _STEPS, np.arange(len(bend)), bend))
        inward = np.arctan2(-at[1], -at[0])
        off = (inward - heading + np.pi) % (2.0 * np.pi) - np.pi
        if np.hypot(*at) > border:
            curve = float(np.sign(off)) * min(abs(off), 1.0)
        heading += curve * _FREE_TURN_RAD / _STEPS
        at = at + base / _STEPS * np.array([np.cos(heading), np.sin(heading)])
        path.append(at)
    course = _along(plan, np.array(path), base * np.cumsum(rng.uniform(*_FREE_BASE, n), dtype=np.float64))
    strays = np.convolve(rng.standard_normal(n + 4), np.ones(5) / np.sqrt(5.0), mode="valid")
    return Course(
        course.at_m - course.at_m.mean(axis=0),
        course.course_deg,
        course.nose_deg + _FREE_NOSE_DEG * strays,
        course.line,
        course.time_s,
    )


def _along(plan: SurveyPlan, path_m: Floats, at_m: Floats) -> Course:
    """Places at distances (n,) along a path (k, 2) of fine steps."""
    steps = np.diff(path_m, axis=0)
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    place = np.column_stack([np.interp(at_m, gone, path_m[:, k]) for k in (0, 1)])
    step = steps[np.clip(np.searchsorted(gone, at_m, side="right") - 1, 0, len(steps) - 1)]
    course = np.degrees(np.arctan2(step[:, 1], step[:, 0]))
    line = np.zeros(len(at_m), dtype=np.int64)
    return Course(place, course, course, line, (at_m - at_m[0]) / plan.speed_m_per_s)


_PATHS: dict[str, Callable[[SurveyPlan], Course]] = {
    "block": _block,
    "line": _block,
    "crossed": _crossed,
    "spiral": _spiral,
    "free": _free,
}
