"""Deviations of what curves are between measurements."""

from __future__ import annotations

import numpy as np

from geomosaic.arrays import Bools, Floats
from geomosaic.ccd.least_squares_matching import measure
from geomosaic.ccd.parallel import each
from geomosaic.ccd.prepared_pairs import PreparedPairs, curve_of


def between_knots_variance(ready: PreparedPairs, knots_px: Floats, used: Bools, cell_lines: int) -> Floats:
    """Variance (2,) of dcol and dline, px², that the spline between knots does not follow.

    Cells of fewer lines are measured along the curves. What they are off by beyond their own noise is what
    the curves miss.
    Args: knots_px (pairs, knots, 2) of the curves; used (pairs, knots): knots that were measured; cell_lines:
    as jitter needs them, fewer than between knots.
    """
    centres = ready.centres
    at = np.arange(round(centres[0] + centres[-1]) + 1, dtype=np.float64)
    count = len(at) // cell_lines
    middles = np.arange(count, dtype=np.float64) * cell_lines + (cell_lines - 1) / 2
    knot = np.rint((middles - centres[0]) / (centres[1] - centres[0])).astype(int)

    def excess(k: int) -> tuple[Floats, Floats]:
        curve = curve_of(centres, knots_px[k], at)
        cells = measure(ready.images[k], curve, ready.pairs[k].known_px[: len(at)], cell_lines)
        off_px = cells.offset_px - curve_of(centres, knots_px[k], middles).T
        information = np.diagonal(cells.information, axis1=1, axis2=2) * used[k, knot, None]
        return (information * off_px**2 - (information > 0.0)).sum(axis=0), information.sum(axis=0)

    beyond, total = (np.sum(part, axis=0) for part in zip(*each(excess, range(len(used))), strict=True))
    return np.asarray(np.maximum(beyond, 0.0) / np.maximum(total, 1e-12))
