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
_STRAIGHT = 0.15
"""Steps that lie within this share of the speed about their median are those of a straight line."""
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

    def alike(self, first: int, last: int, apart_m_per_s: float) -> Floats:
        """Velocities of the steps first to last and of those beside them as far as they go on alike."""
        middle = np.median(self.moved_m[first:last] / self.passed_s[first:last, None], axis=0)
        off_m = np.linalg.norm(self.moved_m - self.passed_s[:, None] * middle, axis=1)
        others = np.flatnonzero(~self.is_step | (off_m >= 2.0 * apart_m_per_s * self.passed_s))
        first = int(others[others < first].max(initial=-1)) + 1
        last = int(others[others >= last].min(initial=len(self.is_step)))
        return self.moved_m[first:last] / self.passed_s[first:last, None]


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

    On a straight line the median of all its steps; where a line ends, that of `velocities_m_per_s`; on a
    curve the slope of the parabola through its position and those before and behind, at an end of the last
    three. Clocks that tell whole seconds are off by a third of a step: by them, parabolas are drawn over the
    way, and the speed is that of some steps together. Speeds that are nearly alike are taken as one, and slow
    climbs as level flight: what is left of them is chance, of which a readout that is solved for would be
    made out to be nothing (a regression on noise).
    """
    out = velocities_m_per_s(positions_m, times_s)
    speeds = np.linalg.norm(out, axis=1)
    if not speeds.any():
        return out
    way = _way(positions_m, times_s)
    straight_m_per_s = _STRAIGHT * float(np.median(speeds[speeds > 0.0]))
    exact = bool((np.abs(times_s - np.round(times_s))[way.at] > _FRACTION_S).mean() > 0.5)
    for k, i in enumerate(way.at):
        first, last = way.about(k)
        lasted, moved = way.passed_s[first:last], way.moved_m[first:last]
        length = np.linalg.norm(moved, axis=1)
        usual = length <= 2.0 * np.median(length) if len(length) else length > 0.0
        if not exact and length[usual].all():
            lasted = np.where(usual, length * lasted[usual].sum() / max(length[usual].sum(), 1e-9), lasted)
        steps, here = moved / lasted[:, None], k - first
        if len(steps) < 2:
            continue
        before, behind = steps[:here], steps[here:]
        if _spread(steps) < straight_m_per_s:
            out[i] = np.median(way.alike(first, last, straight_m_per_s), axis=0)
        elif not len(before) or not len(behind):
            one, other = (steps[0], steps[1]) if len(behind) else (steps[-1], steps[-2])
            out[i] = 1.5 * one - 0.5 * other
        elif not _turns_off(before, behind):
            share = lasted[here - 1] / (lasted[here - 1] + lasted[here])
            out[i] = before[-1] * (1.0 - share) + behind[0] * share
    return _evened(out)


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


def _turns_off(before: Floats, behind: Floats) -> bool:
    """Whether a line ends here: steps before and behind differ, and one side agrees with itself."""
    speed = max(float(np.linalg.norm(before[-1])), float(np.linalg.norm(behind[0])))
    if np.linalg.norm(behind[0] - before[-1]) <= _ALIKE * speed:
        return False
    return min(_spread(before), _spread(behind)) < _ALIKE * speed / 4.0


def _spread(steps: Floats) -> float:
    """How far steps lie from their median, in the mean; of one alone that can't be told."""
    if len(steps) < 2:
        return float("inf")
    return float(np.linalg.norm(steps - np.median(steps, axis=0), axis=1).mean())
