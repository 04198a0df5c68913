"""Values in a DEM that are no heights, though the file doesn't say so: fills, and lone pixels far off."""

from __future__ import annotations

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats, Floats32
from geomosaic.constants import ENOUGH, ROUNDS, sourced, tuned

_LAND_M = sourced((-600.0, 9100.0), "m", "land, so no -999 or 9999", "Dead Sea shore -430 m, Everest 8849 m")
_FILL_BELOW_M = tuned(
    20.0, "m", "step around a low fill: less loses the sea next to cliffs; more keeps fills"
)
_FILL_MOST_M = tuned(100.0, "m", "the same for a value of most cells: less loses plains with towers")
_FILL_ABOVE_M = tuned(300.0, "m", "step around a high fill: less loses towers with flat roofs")
_FILL_STEPS = tuned(4.0, "99 % steps", "a fill's step over the usual: less loses cliffs in mountains")
_SPIKE_M = tuned(50.0, "m", "height of a lone wrong pixel: less does a mosaic no harm")
_SPIKE_SPREADS = tuned(10.0, "95 % differences", "of a lone wrong pixel: less loses sharp summits")


def outliers(height_m: Floats, mixed: bool = False) -> Bools:
    """Where heights (rows, cols), NaN where unknown, can't be the ground's.

    These are heights outside the land's range, fills, and pixels far off nearly all of those around them. A
    fill is one and the same value, the lowest or highest of all, that ends everywhere in a step as there is
    none elsewhere. mixed: the neighbours of fills are mixtures of both, and go too.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        bad = (height_m < _LAND_M[0]) | (height_m > _LAND_M[1])
        left = np.where(bad, np.nan, height_m).astype(np.float32)
    for lowest in (True, False):
        for _ in range(ROUNDS):
            fill = _fill(left, lowest)
            if fill is None:
                break
            bad |= fill
            left[fill] = np.nan
    if mixed and bad.any():
        adjacent = cv2.dilate(bad.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        bad |= adjacent & np.isfinite(left)
        left[bad] = np.nan
    return bad | _spikes(left)


def _fill(height_m: Floats32, lowest: bool) -> Bools | None:
    """Where the lowest (highest) value is, if it stands in many pixels and is a fill."""
    known = np.isfinite(height_m)
    if not known.any():
        return None
    value = np.nanmin(height_m) if lowest else np.nanmax(height_m)
    its = height_m == value
    if np.count_nonzero(its) < 2:
        return None
    at_border, elsewhere = [], []
    for axis in (0, 1):
        step = np.abs(np.diff(height_m, axis=axis))
        here = np.diff(its, axis=axis)
        at_border.append(step[here & np.isfinite(step)])
        elsewhere.append(step[~here & np.isfinite(step) & ~_both(its, axis)])
    border, ordinary = np.concatenate(at_border), np.concatenate(elsewhere)
    if not border.size or ordinary.size < ENOUGH:
        return None
    usual = float(np.percentile(ordinary, 99.0))
    small = np.count_nonzero(its) < 0.5 * np.count_nonzero(known)
    least = max((_FILL_BELOW_M if small else _FILL_MOST_M) if lowest else _FILL_ABOVE_M, _FILL_STEPS * usual)
    return its if float(np.median(border)) > least else None


def _both(flags: Bools, axis: int) -> Bools:
    return np.asarray(flags[1:] & flags[:-1] if axis == 0 else flags[:, 1:] & flags[:, :-1])


def _spikes(height_m: Floats32) -> Bools:
    """Pixels that at most two of the eight around them come near to; unknown ones count as near."""
    if min(height_m.shape) < 3:
        return np.zeros(height_m.shape, dtype=bool)
    around = np.pad(height_m, 1, mode="reflect")
    rows, cols = height_m.shape
    first, second, third = (np.full(height_m.shape, np.inf, np.float32) for _ in range(3))
    for row in range(3):
        for col in range(3):
            if (row, col) != (1, 1):
                away = np.nan_to_num(np.abs(around[row : row + rows, col : col + cols] - height_m), nan=0.0)
                third = np.minimum(third, np.maximum(second, away))
                second = np.minimum(second, np.maximum(first, away))
                first = np.minimum(first, away)
    spread = float(np.percentile(third, 95.0))
    return np.asarray(third > max(_SPIKE_M, _SPIKE_SPREADS * spread))
