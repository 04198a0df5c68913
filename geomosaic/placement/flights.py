"""Which frames were taken in one flight."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from geomosaic.arrays import Floats, Ints
from geomosaic.constants import tuned
from geomosaic.placement.velocity import PAUSE

_PAUSE_S = tuned(120.0, "s", "between two flights: less parts a hover; more joins quick changes of battery")


def flights_of(times_s: Floats, names: Sequence[str]) -> Ints:
    """Number of each frame's flight, (n,), by time; a pause without frames parts two. Frames that were taken
    in it and are not at hand show by the numbers in the names. All 0 where a time is unknown.
    Args: times_s (n,), NaN where unknown: `Survey.clock_times_s`, by which aircraft follow each other."""
    out = np.zeros(len(times_s), dtype=np.intp)
    if len(times_s) < 2 or not np.isfinite(times_s).all():
        return out
    order = np.argsort(times_s, kind="stable")
    passed_s = np.diff(times_s[order])
    usual_s = float(np.median(passed_s))
    idle_s = passed_s - usual_s * _not_at_hand([names[i] for i in order])
    out[order[1:]] = np.cumsum(idle_s > max(_PAUSE_S, PAUSE * usual_s))
    return out


def _not_at_hand(names: Sequence[str]) -> Floats:
    """How many frames' numbers lie between each name and the next, (n - 1,). The number of a frame is the one
    in its name that rises least."""
    numbers = [re.findall(r"\d+", name) for name in names]
    none = np.zeros(len(names) - 1)
    if len({len(found) for found in numbers}) != 1 or not numbers[0]:
        return none
    steps = np.diff(np.array(numbers, dtype=np.float64), axis=0)
    usual = np.median(steps, axis=0)
    if not (usual > 0.0).any():
        return none
    which = int(np.where(usual > 0.0, usual, np.inf).argmin())
    return np.asarray(np.maximum(steps[:, which] / usual[which] - 1.0, 0.0))
