"""How fast the platform flew, from where and when the frames were taken."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import SLIGHT, sourced, tuned
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.placement.smoothing_spline import slopes

_STEPS = tuned(3, "steps", "each side, for a median: fewer show clock rounding; more straighten curves")
PAUSE = tuned(3.0, "usual intervals", "between lines: less splits at a lost frame; more crosses turns")
_CORNER = sourced(1.35, "usual speeds", "change at a corner: less breaks jittery lines", "2 sin(85 deg / 2)")
_FASTEST = tuned(150.0, "m/s", "of a step: less loses survey aircraft; more joins two that fly at once")


@dataclass(frozen=True)
class _Way:
    """Frames `at` in the order of their times, (n,), and the steps from each to the next. A step has the time
    that passed (n - 1,), the move (n - 1, 3), and whether it is a step rather than a pause."""

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

    def ways(self) -> list[tuple[int, int]]:
        """First and last frame of each way without a pause or a corner."""
        steps = self.moved_m / np.where(self.is_step, self.passed_s, np.inf)[:, None]
        speed = np.linalg.norm(steps, axis=1)
        usual = float(np.median(speed[self.is_step])) if self.is_step.any() else 0.0
        turned = np.linalg.norm(np.diff(steps, axis=0), axis=1) > _CORNER * usual
        ends = np.unique(
            [0, *(1 + np.flatnonzero(turned | ~self.is_step[:-1] | ~self.is_step[1:])), len(steps)]
        )
        return [(int(a), int(b)) for a, b in itertools.pairwise(ends) if self.is_step[a:b].all()]

    def steps_m_per_s(self, exact: bool) -> Floats:
        """Velocities from each frame to the next, (n - 1, 3), by `clock`; NaN across pauses."""
        passed_s = np.where(self.is_step, self.passed_s, np.nan)
        for first, last in self.ways():
            passed_s[first:last] = np.diff(self.clock(first, last, exact))
        return self.moved_m / passed_s[:, None]

    def clock(self, first: int, last: int, exact: bool) -> Floats:
        """Times of a way from its beginning; by how far the frames lie apart where the clock is coarse."""
        passed_s = self.passed_s[first:last]
        length = np.linalg.norm(self.moved_m[first:last], axis=1)
        if not exact and length.all():
            passed_s = length * passed_s.sum() / length.sum()
        return np.concatenate([[0.0], np.cumsum(passed_s)])


def _way(positions_m: Floats, times_s: Floats) -> _Way:
    at = np.flatnonzero(np.isfinite(times_s))
    at = at[np.argsort(times_s[at], kind="stable")]
    passed, moved = np.diff(_apart(times_s[at])), np.diff(positions_m[at], axis=0)
    is_step = (passed > 0.0) & (np.linalg.norm(moved, axis=1) <= _FASTEST * passed)
    if is_step.any():
        is_step &= passed <= PAUSE * float(np.median(passed[is_step]))
    return _Way(at, passed, moved, is_step)


def velocities_m_per_s(positions_m: Floats, times_s: Floats) -> Floats:
    """Velocity of each frame, (n, 3).

    The median, axis by axis, of the steps from frame to frame up to three before and three behind. So neither
    whole seconds of a clock nor a position far off count much. Where the steps before and behind differ, as
    at the end of a line, it is the median of the side that agrees with itself. Nothing is known across
    pauses, and across steps faster than aircraft fly. 0 where times are missing.

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
            if float(np.linalg.norm(one - other)) > speed / 2.0:
                out[i] = one if _spread(before) < _spread(behind) else other
                continue
        if len(steps):
            out[i] = np.median(steps, axis=0)
    return out


def flown_m_per_s(positions_m: Floats, times_s: Floats) -> Floats:
    """Velocities (n, 3) by positions that are sure to a small part of a step.

    The slopes of smoothing splines through the ways between pauses and corners. All ways together determine
    how much of the departure from a straight line is flown, and how much is jitter. Level and upright
    components are treated separately. A frame at a corner flies as the longer way does. Clocks that report
    whole seconds are off by a third of a step; times then follow from the lengths of the steps.
    """
    out, way = velocities_m_per_s(positions_m, times_s), _way(positions_m, times_s)
    if not out.any():
        return out
    exact, ways = _exact(times_s[way.at]), way.ways()
    clocks = [way.clock(first, last, exact) for first, last in ways]
    places = [positions_m[way.at[first : last + 1]] for first, last in ways]
    level, upright = (slopes(clocks, [p[:, axes] for p in places]) for axes in ([0, 1], [2]))
    for k in sorted(range(len(ways)), key=lambda k: ways[k][1] - ways[k][0]):
        out[way.at[ways[k][0] : ways[k][1] + 1]] = np.column_stack([level[k], upright[k]])
    return out


def unsteady_m_per_s(positions_m: Floats, times_s: Floats) -> Floats:
    """By how much the velocity of each frame may differ from `flown_m_per_s`, (n,). It is half of the
    difference of the steps before and behind the frame, where that is more than three times the median. At
    the ends of a way, which may curve, it is half of the difference at the adjacent frame. It is 0
    elsewhere."""
    out, way = np.zeros(len(times_s)), _way(positions_m, times_s)
    if len(way.at) < 3:
        return out
    steps = way.steps_m_per_s(_exact(times_s[way.at]))
    change = np.pad(np.linalg.norm(np.diff(steps, axis=0), axis=1), 1, constant_values=np.nan)
    next_to_it = np.fmax(np.roll(change, 1), np.roll(change, -1))
    ends = np.isnan(change)
    change = np.nan_to_num(np.where(ends, next_to_it, change))
    out[way.at] = np.where(ends | (change > THREE_SIGMA * np.median(change)), 0.5 * change, 0.0)
    return out


def _apart(times_s: Floats) -> Floats:
    """Times in order; by a clock of whole seconds, frames of one second share it evenly."""
    if len(set(times_s.tolist())) < 2 or _exact(times_s):
        return times_s
    _, first, second, count = np.unique(times_s, return_index=True, return_inverse=True, return_counts=True)
    return times_s + (np.arange(len(times_s)) - first[second] + 0.5) / count[second]


def _exact(times_s: Floats) -> bool:
    """Whether a clock reports more than whole seconds."""
    return bool((np.abs(times_s - np.round(times_s)) > SLIGHT).mean() > 0.5)


def _spread(steps: Floats) -> float:
    """How far steps lie from their median, in the mean; of one alone that isn't known."""
    if len(steps) < 2:
        return float("inf")
    return float(np.linalg.norm(steps - np.median(steps, axis=0), axis=1).mean())
