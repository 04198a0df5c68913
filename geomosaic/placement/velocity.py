"""How fast the platform flew, from where and when the frames were taken."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_STEPS = 3


def velocities_m_per_s(positions_m: Floats, times_s: Floats, lines: tuple[int, ...]) -> Floats:
    """Velocity of each frame in its flight line, (n, 3).

    The median, axis by axis, of the steps from frame to frame up to three before and three behind, so that
    neither whole seconds of a clock nor a position far off tell much. 0 where times are missing.

    Args: positions_m (n, 3), times_s (n,) or NaN, in order of capture.
    """
    out = np.zeros_like(positions_m)
    line = np.asarray(lines)
    for number in np.unique(line):
        at = np.flatnonzero(line == number)
        passed = np.diff(times_s[at])
        with np.errstate(invalid="ignore", divide="ignore"):
            steps = np.diff(positions_m[at], axis=0) / np.where(passed > 0.0, passed, np.nan)[:, None]
        for k, i in enumerate(at):
            near = steps[max(k - _STEPS, 0) : k + _STEPS]
            near = near[np.isfinite(near).all(axis=1)]
            if len(near):
                out[i] = np.median(near, axis=0)
    return out
