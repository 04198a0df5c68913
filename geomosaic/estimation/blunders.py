"""Blunders among observations of one quantity, found against the other observations."""

from __future__ import annotations

import numpy as np
from scipy.special import stdtrit

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned

LEAST = sourced(5, "observations", "to call one a blunder", "the median holds with 2 of 5 wrong, MAD too")
_LEVEL = sourced(0.0027, "probability", "of a blunder among normal errors", "beyond three deviations")
_OWN = tuned(2.0, "stated deviations", "least size; less: chance agreement of others names good points")
_CLEAR = tuned(5.0, "deviations", "blunders by stated deviation and scatter; fewer: good points are named")


def blunders(values: Floats, sd: Floats) -> Bools:
    """Which of n observations (n,) are blunders; none among fewer than five.

    The standard deviations (n,) may hold an error that all observations share. A blunder differs from the
    median by more than two of its deviations and by more than the scatter of the others explains (Rosner
    1983: generalised extreme studentised deviates); or by more than five deviations, stated and by the MAD.

    Args: values, sd: in one unit, finite, sd > 0.
    """
    n = len(values)
    if n < LEAST:
        return np.zeros(n, dtype=bool)
    off = np.abs(values - np.median(values))
    mad = NORMAL_PER_MAD * float(np.median(off / sd))
    found = np.asarray(off > _CLEAR * max(mad, 1.0) * sd)
    order = np.argsort(-off / sd, kind="stable")
    for k in range((n - 3) // 2, 0, -1):
        tested, rest = order[k - 1], order[k:]
        if off[tested] > _OWN * sd[tested] and _studentised(values, sd, tested, rest) > _quantile(len(rest)):
            found[order[:k]] = True
            break
    return found


def _studentised(values: Floats, sd: Floats, tested: np.intp, rest: Ints) -> float:
    """Distance of an observation from the weighted mean of the rest, over the deviation of that distance."""
    weight = 1.0 / sd[rest] ** 2
    mean = float(weight @ values[rest] / weight.sum())
    factor = float(np.sqrt(weight @ (values[rest] - mean) ** 2 / (len(rest) - 1)))
    spread = factor * float(np.sqrt(sd[tested] ** 2 + 1.0 / weight.sum()))
    return abs(float(values[tested]) - mean) / max(spread, np.finfo(np.float64).tiny)


def _quantile(rest: int) -> float:
    """Student's quantile for the most extreme of rest + 1 observations."""
    return float(stdtrit(rest - 1, 1.0 - _LEVEL / (2.0 * (rest + 1))))
