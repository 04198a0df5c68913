"""The order of the worst frames and pairs, and the limit of a wrong heading.

`inspect`, `view`, the report and `diff` all use these.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.placement.prior import COURSE_YAW_SD_DEG, heading_limit_rad

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


def wrong_headings(off_deg: Floats, given_sd_deg: Floats) -> NDArray[np.bool_]:
    """Headings (n,) that are off by more than their limit; one that nobody observed isn't wrong."""
    limit_deg = np.degrees(heading_limit_rad(np.radians(given_sd_deg)))
    return np.asarray((np.abs(off_deg) > limit_deg) & ~(given_sd_deg >= COURSE_YAW_SD_DEG - 1e-9))
