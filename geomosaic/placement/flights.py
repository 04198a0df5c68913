"""Which frames were taken in one flight."""

from __future__ import annotations

import numpy as np

from geomosaic.arrays import Floats, Ints
from geomosaic.constants import tuned
from geomosaic.placement.velocity import PAUSE

_PAUSE_S = tuned(120.0, "s", "between two flights: less parts a hover; more joins quick changes of battery")


def flights_of(times_s: Floats) -> Ints:
    """Number of each frame's flight, (n,), by time; a pause parts two. All 0 where a time is unknown.
    Args: times_s (n,), NaN where unknown: `Survey.clock_times_s`, by which aircraft follow each other."""
    if not len(times_s) or not np.isfinite(times_s).all():
        return np.zeros(len(times_s), dtype=np.intp)
    order = np.argsort(times_s, kind="stable")
    passed_s = np.diff(times_s[order])
    pause_s = max(_PAUSE_S, PAUSE * float(np.median(passed_s))) if len(passed_s) else _PAUSE_S
    out = np.zeros(len(times_s), dtype=np.intp)
    out[order[1:]] = np.cumsum(passed_s > pause_s)
    return out
