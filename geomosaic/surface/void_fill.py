"""Heights of voids: the second lowest of the nearest matched heights in eight directions.

Voids are mostly occlusions at the foot of walls. The mean of their surroundings would be a ramp.
"""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats32
from geomosaic.constants import tuned
from geomosaic.surface.visibility import REACH_CELLS

SHARE_AROUND = tuned(0.25, "share", "known cells around: less keeps islands on water; more loses roofs")
NEAR_CELLS = tuned(5, "cells", "median of filled heights, coarse range: smaller leaves streaks, misses walls")
_ENCLOSED = tuned(6, "directions", "with a known cell that enclose a void: fewer extend houses past the rim")
_REACH_CELLS: Final = 2 * REACH_CELLS
"""Search each way: a void is what walls on both sides hide."""
SEARCH_CELLS: Final = _REACH_CELLS + NEAR_CELLS // 2
"""About some cells, from where their heights come."""


def void_heights(values: Floats32, known: Bools) -> tuple[Floats32, Bools]:
    """Heights of voids (rows, cols), and which cells known ones enclose.

    Each is the second lowest of the nearest known values in eight directions, after a median filter. The
    lowest alone may be a blunder. Heights are infinite where few cells are known. Cells that are not enclosed
    may lie at the rim of the matched area, where a single house would be extrapolated.
    """
    lowest, second = (np.full(values.shape, np.inf, dtype=np.float32) for _ in range(2))
    count = np.zeros(values.shape, dtype=np.uint8)
    for quarters in range(4 * known.any()):
        turned, where = np.rot90(values, quarters), np.rot90(known, quarters)
        sheared = _nearest_above(_sheared(turned), _sheared(where))
        for near in (_nearest_above(turned, where), _unsheared(sheared, turned.shape[1])):
            near = np.rot90(near, -quarters)
            np.minimum(second, np.maximum(lowest, near), out=second)
            np.minimum(lowest, near, out=lowest)
            count += near < np.inf
    far = np.float32(np.finfo(np.float32).max)
    evened = np.asarray(cv2.medianBlur(np.minimum(second, far), NEAR_CELLS), dtype=np.float32)
    window = (_REACH_CELLS + 1, _REACH_CELLS + 1)
    share = cv2.blur(known.astype(np.float32), window, borderType=cv2.BORDER_CONSTANT)
    there = (evened < far) & (share >= SHARE_AROUND)
    return np.where(there, evened, np.float32(np.inf)), there & (count >= _ENCLOSED)


def _nearest_above(values: Floats32, known: Bools) -> Floats32:
    """Of each cell the last known value in the rows before; infinite where it is farther than is looked."""
    row = np.arange(len(values), dtype=np.int32)[:, None]
    last = np.maximum.accumulate(np.where(known, row, np.int32(-_REACH_CELLS - 1)), axis=0)
    near = np.take_along_axis(values, np.maximum(last, 0), axis=0)
    return np.asarray(np.where(row - last <= _REACH_CELLS, near, np.float32(np.inf)))


def _sheared(values: NDArray[Any]) -> NDArray[Any]:
    """Values (rows, cols) moved so that those of a diagonal stand one below the other, zeros about them."""
    rows, cols = values.shape
    flat = np.zeros(rows * (cols + rows + 1), dtype=values.dtype)
    flat[: rows * (cols + rows)].reshape(rows, -1)[:, rows:] = values
    return flat.reshape(rows, -1)


def _unsheared(values: Floats32, cols: int) -> Floats32:
    rows = len(values)
    return values.ravel()[: rows * (cols + rows)].reshape(rows, -1)[:, rows:]
