"""From where on a figure is drawn as bad: the verdict's own limits, so that a survey that is bad everywhere
is red everywhere."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.quality.criteria import CRITERIA


class _Limits(NamedTuple):
    good: float
    bad: float


RESIDUAL: Final = CRITERIA["seams"]
"""Ground pixels between two frames: what is left between them is what their seam jumps by."""
MOVE: Final = _Limits(3.0, 6.0)
"""Deviations, given and found ones together: how far a frame lies from where its position was given."""


def badness(values: Floats, good: float, bad: float) -> Floats:
    """0 for none, 0.5 at the last good value, 1 from the first bad one on; NaN stays."""
    return np.asarray(np.interp(values, (0.0, good, bad), (0.0, 0.5, 1.0)) + 0.0 * values)


def moves_sd(moved_m: Floats, given_sd_m: Floats, found_sd_m: Floats) -> Floats:
    """How many deviations moves over the ground (n, 2) are long, by the larger of both axes' (n, 2 each),
    (n,); NaN where these are unknown."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        sd_m = np.hypot(given_sd_m, np.nan_to_num(found_sd_m)).max(axis=1)
        return np.asarray(np.hypot(*moved_m.T) / np.where(sd_m > 0.0, sd_m, np.nan))
