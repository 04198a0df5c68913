"""How fast the platform flew, from where and when the frames were taken."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_STEPS = 3
_PAUSE = 3.0
"""A time between frames that is so many times the usual one is the way to another line."""
_ALIKE = 0.5
"""Before and behind a frame velocities that differ by less than this share of the speed are one."""


def velocities_m_per_s(positions_m: Floats, times_s: Floats) -> Floats:
    """Velocity of each frame, (n, 3).

    The median, axis by axis, of the steps from frame to frame up to three before and three behind, so that
    neither whole seconds of a clock nor a position far off tell much; where these differ, as at the end of a
    line, of the side that agrees with itself. Across pauses nothing is told. 0 where times are missing.

    Args: positions_m (n, 3), times_s (n,) or NaN.
    """
    out = np.zeros_like(positions_m)
    at = np.flatnonzero(np.isfinite(times_s))
    at = at[np.argsort(times_s[at], kind="stable")]
    passed = np.diff(times_s[at])
    if not (passed > 0.0).any():
        return out
    usual = float(np.median(passed[passed > 0.0]))
    passed = np.where((passed > 0.0) & (passed <= _PAUSE * usual), passed, np.nan)
    steps = np.diff(positions_m[at], axis=0) / passed[:, None]
    pauses = np.flatnonzero(np.isnan(passed))
    for k, i in enumerate(at):
        first = int(pauses[pauses < k].max(initial=-1)) + 1
        last = int(pauses[pauses >= k].min(initial=len(steps)))
        before, behind = steps[max(k - _STEPS, first) : k], steps[k : min(k + _STEPS, last)]
        if len(before) and len(behind):
            one, other = np.median(before, axis=0), np.median(behind, axis=0)
            speed = max(float(np.linalg.norm(one)), float(np.linalg.norm(other)))
            if float(np.linalg.norm(one - other)) > _ALIKE * speed:
                out[i] = one if _spread(before) < _spread(behind) else other
                continue
        if len(both := np.concatenate([before, behind])):
            out[i] = np.median(both, axis=0)
    return out


def _spread(steps: Floats) -> float:
    """How far steps lie from their median, in the mean; of one alone that can't be told."""
    if len(steps) < 2:
        return float("inf")
    return float(np.linalg.norm(steps - np.median(steps, axis=0), axis=1).mean())
