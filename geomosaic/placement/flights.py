"""Which frames were taken in one flight."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import DAY_S, sourced, tuned
from geomosaic.placement.velocity import PAUSE

_CLOCK_S = sourced(
    2.0, "s", "of two spans by clocks of whole seconds", "definition: each is off by less than 1 s"
)
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
    idle_s = passed_s - usual_s * _not_at_hand([names[i] for i in order], passed_s)
    out[order[1:]] = np.cumsum(idle_s > max(_PAUSE_S, PAUSE * usual_s))
    return out


def _not_at_hand(names: Sequence[str], passed_s: Floats) -> Floats:
    """How many frames' numbers lie between each name and the next, (n - 1,), passed_s after it. The number of
    a frame is the one in its name that rises least and is no time of day, which rises in pauses too."""
    numbers = [re.findall(r"\d+", name) for name in names]
    none = np.zeros(len(names) - 1)
    if len({len(found) for found in numbers}) != 1 or not numbers[0]:
        return none
    steps = np.diff(np.array(numbers, dtype=np.float64), axis=0)
    usual = np.median(steps, axis=0)
    usual[_clocks(np.array(numbers), passed_s)] = 0.0
    if not (usual > 0.0).any():
        return none
    which = int(np.where(usual > 0.0, usual, np.inf).argmin())
    return np.asarray(np.maximum(steps[:, which] / usual[which] - 1.0, 0.0))


def _clocks(numbers: NDArray[np.str_], passed_s: Floats) -> Bools:
    """Which numbers of names (n, k) are times. In the longest pause these rise by what passes: in seconds, in
    milliseconds, or as hours, minutes and seconds of the day."""
    pause = int(passed_s.argmax())
    out = np.zeros(numbers.shape[1], dtype=bool)
    for k, (before, after) in enumerate(zip(numbers[pause], numbers[pause + 1], strict=True)):
        rises_s = [float(after) - float(before), (float(after) - float(before)) / 1000.0]
        for digits in (6, 9):
            if len(before) >= digits and len(after) >= digits:
                first, last = (_of_day_s(text[-digits:]) for text in (before, after))
                rises_s.append((last - first) % DAY_S)
        out[k] = min(abs(rise - passed_s[pause]) for rise in rises_s) <= _CLOCK_S
    return out


def _of_day_s(text: str) -> float:
    """Seconds of the day by digits as hhmmss, with milliseconds if there are more."""
    return 3600.0 * int(text[:2]) + 60.0 * int(text[2:4]) + float(text[4:]) / 10.0 ** (len(text) - 6)
