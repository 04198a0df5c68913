"""How fast the platform flew, from where and when the frames were taken."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
_STEPS = 3
_PAUSE = 3.0
"""A time between frames that is so many times the usual one is the way to another line."""
_CORNER = 1.35
"""A change of velocity from step to step by so many times the speed, a turn by 85 degrees, is no curve."""
_CLEARLY = 6.0
"""F by which a curve has to fit better than a line: 1 in 100 lines, with 6 and 9 degrees of freedom."""
_CLIMBS, _NEARLY = 0.1, 0.2
"""Climbs below this share of the speed, and speeds that differ by less than that, are taken as none."""
_FRACTION_S = 0.01
_ALIKE = 0.5
"""Before and behind a frame velocities that differ by less than this share of the speed are one."""


@dataclass(frozen=True)
class _Way:
    """Frames `at` by their times, (n,); from each to the next the time that passed and the move, (n - 1,) and
    (n - 1, 3); whether that is a step, no pause."""

    at: Ints
    passed_s: Floats
    moved_m: Floats
    is_step: Bools

    def about(self, k: int) -> tuple[int, int]:
        """The steps about the k-th frame, three before and three behind, that no pause parts from it."""
        first, last = k, k
        while first > max(k - _STEPS, 0) and self.is_step[first - 1]:
            first -= 1
        while last < min(k + _STEPS, len(self.is_step)) and self.is_step[last]:
            last += 1
        return first, last

    def straight(self, k: int) -> tuple[int, int]:
        """Of these steps those between corners; for a frame at a corner the side that agrees with itself."""
        first, last = self.about(k)
        steps = self.moved_m[first:last] / self.passed_s[first:last, None]
        if len(steps) < 2:
            return first, last
        speed = float(np.median(np.linalg.norm(steps, axis=1)))
        corners = first + 1 + np.flatnonzero(np.linalg.norm(np.diff(steps, axis=0), axis=1) > _CORNER * speed)
        before = int(corners[corners < k].max(initial=first))
        behind = int(corners[corners > k].min(initial=last))
        if k not in corners:
            return before, behind
        one, other = steps[before - first : k - first], steps[k - first : behind - first]
        return (before, k) if _spread(one) < _spread(other) else (k, behind)


def _way(positions_m: Floats, times_s: Floats) -> _Way:
    at = np.flatnonzero(np.isfinite(times_s))
    at = at[np.argsort(times_s[at], kind="stable")]
    passed = np.diff(times_s[at])
    is_step = passed > 0.0
    if is_step.any():
        is_step &= passed <= _PAUSE * float(np.median(passed[is_step]))
    return _Way(at, passed, np.diff(positions_m[at], axis=0), is_step)


def velocities_m_per_s(positions_m: Floats, times_s: Floats) -> Floats:
    """Velocity of each frame, (n, 3).

    The median, axis by axis, of the steps from frame to frame up to three before and three behind, so that
    neither whole seconds of a clock nor a position far off tell much; where these differ, as at the end of a
    line, of the side that agrees with itself. Across pauses nothing is told. 0 where times are missing.

    Args: positions_m (n, 3), times_s (n,) or NaN.
    """
    out, way = np.zeros_like(positions_m), _way(positions_m, times_s)
    for k, i in enumerate(way.at):
        first, last = way.about(k)
        steps = way.moved_m[first:last] / way.passed_s[first:last, None]
        before, behind = steps[: k - first], steps[k - first :]
        if len(before) and len(behind):
            one, other = np.median(before, axis=0), np.median(behind, axis=0)
            speed = max(float(np.linalg.norm(one)), float(np.linalg.norm(other)))
            if float(np.linalg.norm(one - other)) > _ALIKE * speed:
                out[i] = one if _spread(before) < _spread(behind) else other
                continue
        if len(steps):
            out[i] = np.median(steps, axis=0)
    return out


def flown_m_per_s(positions_m: Floats, times_s: Floats) -> Floats:
    """Velocities (n, 3) by positions that are sure to a small part of a step.

    The slope of a line through the positions up to three frames before and three behind: a platform is thrown
    about its way by a metre and flies on at its speed, of which seven frames tell more than two. On a curve
    (F test) that of the parabola through its position and those beside it; where a line ends, of its own
    side. Clocks that tell whole seconds are off by a third of a step: by them, times go by the way. Speeds
    that are nearly alike are taken as one, and slow climbs as level flight: what is left of them is chance,
    of which a readout that is solved for would be made out to be nothing (a regression on noise).
    """
    out, way = velocities_m_per_s(positions_m, times_s), _way(positions_m, times_s)
    if not out.any():
        return out
    exact = bool((np.abs(times_s - np.round(times_s))[way.at] > _FRACTION_S).mean() > 0.5)
    for k, i in enumerate(way.at):
        first, last = way.straight(k)
        passed_s = way.passed_s[first:last]
        length = np.linalg.norm(way.moved_m[first:last], axis=1)
        if not exact and length.all():
            passed_s = length * passed_s.sum() / length.sum()
        if len(passed_s) > 1:
            times = np.concatenate([[0.0], np.cumsum(passed_s)])
            out[i] = _slope(times - times[k - first], positions_m[way.at[first : last + 1]])
    return _evened(out)


def _slope(times_s: Floats, positions_m: Floats) -> Floats:
    """At time 0 of the line through positions (m, 3); where a polynomial of the third degree fits clearly
    better, of the parabola through the three positions that are nearest in time."""
    line, off = _polynomial(times_s, positions_m, 1)
    degree = min(3, len(times_s) - 2)
    if degree < 2:
        return np.asarray(line[1])
    _, left = _polynomial(times_s, positions_m, degree)
    free = len(times_s) - degree - 1
    if (off - left) / (degree - 1) * free <= _CLEARLY * left:
        return np.asarray(line[1])
    nearest = np.sort(np.argsort(np.abs(times_s), kind="stable")[:3])
    return np.asarray(_polynomial(times_s[nearest], positions_m[nearest], 2)[0][1])


def _polynomial(times_s: Floats, positions_m: Floats, degree: int) -> tuple[Floats, float]:
    """Its coefficients (degree + 1, 3), and the sum of squares that it leaves."""
    powers = np.vander(times_s, degree + 1, increasing=True)
    found, *_ = np.linalg.lstsq(powers, positions_m, rcond=None)
    return np.asarray(found, dtype=np.float64), float(((positions_m - powers @ found) ** 2).sum())


def _evened(velocities: Floats) -> Floats:
    """Level where they climb slowly, at the usual speed where theirs is near it."""
    out = velocities.copy()
    out[np.abs(out[:, 2]) < _CLIMBS * np.linalg.norm(out[:, :2], axis=1), 2] = 0.0
    speed = np.linalg.norm(out, axis=1)
    if not speed.any():
        return out
    usual = float(np.median(speed[speed > 0.0]))
    alike = np.abs(speed - usual) < _NEARLY * usual
    out[alike] *= (usual / speed[alike])[:, None]
    return out


def _spread(steps: Floats) -> float:
    """How far steps lie from their median, in the mean; of one alone that can't be told."""
    if len(steps) < 2:
        return float("inf")
    return float(np.linalg.norm(steps - np.median(steps, axis=0), axis=1).mean())
