"""The order of the worst frames and pairs, the limit of a wrong heading, and from where on a figure is bad.

Limits are the verdict's own, so that a survey that is bad everywhere is drawn red everywhere.

`inspect`, `view`, the report and `diff` all use these.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Bools, Floats
from geomosaic.constants import tuned
from geomosaic.estimation.robust import BLUNDER, THREE_SIGMA
from geomosaic.placement.prior import COURSE_YAW_SD_DEG, heading_limit_rad
from geomosaic.quality.criteria import CRITERIA


class _Limits(NamedTuple):
    good: float
    bad: float


RESIDUAL: Final = CRITERIA["seams"]
"""Ground pixels between two frames: what is left between them is what their seam jumps by."""
MOVE: Final = _Limits(THREE_SIGMA, BLUNDER)

WORST_PAIRS = tuned(20, "pairs", "checked in the pixels: more than a person looks through")


def worst_pairs(rms_m: ArrayLike, most: int | None = None) -> list[int]:
    """Rows of pairs by their residuals (n,), the largest first; pairs of which none is known come last."""
    order = np.argsort(-np.nan_to_num(np.asarray(rms_m, dtype=np.float64), nan=-1.0), kind="stable")
    return [int(i) for i in order[:most]]


def worst_frames(loose: ArrayLike, wrong: ArrayLike, moved_m: ArrayLike, turned_deg: ArrayLike) -> list[int]:
    """Rows of frames, (n,) each, worst first.

    loose: frames that aren't tied come first; wrong: then those whose tags are wrong; of each the ones that
    moved farthest, and of these the ones that turned most.
    """
    moved, turned = (np.abs(np.nan_to_num(np.asarray(v, dtype=np.float64))) for v in (moved_m, turned_deg))
    order = np.lexsort((-turned, -moved, ~np.asarray(wrong, dtype=bool), ~np.asarray(loose, dtype=bool)))
    return [int(i) for i in order]


def headings_off_deg(given_deg: Floats, found_deg: Floats) -> Floats:
    """Found minus given headings, (n,), -180 to 180."""
    return np.asarray((found_deg - given_deg + 180.0) % 360.0 - 180.0)


def wrong_headings(off_deg: Floats, given_sd_deg: Floats) -> Bools:
    """Headings (n,) that are off by more than their limit; one that nobody observed isn't wrong."""
    limit_deg = np.degrees(heading_limit_rad(np.radians(given_sd_deg)))
    return np.asarray((np.abs(off_deg) > limit_deg) & ~(given_sd_deg >= COURSE_YAW_SD_DEG - 1e-9))


def badness(values: Floats, good: float, bad: float) -> Floats:
    """0 for none, 0.5 at the last good value, 1 from the first bad one on; NaN stays."""
    return np.asarray(np.interp(values, (0.0, good, bad), (0.0, 0.5, 1.0)) + 0.0 * values)


def moves_sd(moved_m: Floats, given_sd_m: Floats, found_sd_m: Floats) -> Floats:
    """How many deviations moves over the ground (n, 2) are long, by the larger of both axes' (n, 2 each),
    (n,); NaN where these are unknown."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        sd_m = np.hypot(given_sd_m, np.nan_to_num(found_sd_m)).max(axis=1)
        return np.asarray(np.hypot(*moved_m.T) / np.where(sd_m > 0.0, sd_m, np.nan))
