"""The centre of a cross or of a target of quadrants near a mark, to a fraction of a pixel."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats
from geomosaic.constants import tuned

_REACHES_PX = tuned((4, 7), "px", "half windows; smaller: noise decides; larger: the target's edges do")
_MOST_MOVE_PX = tuned(5.0, "px", "of a mark; less: rough clicks stay; more: the next corner is found")
_AGREE_PX = tuned(0.5, "px", "between windows; less: blurred targets fail; more: what is no corner passes")
_LEAST_CONTRAST = tuned(30.0, "grey levels", "of a target; less: grass is refined; more: faded paint is not")
_ROUNDS = tuned((cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.01), "rounds, px", "to the end")
_CENTRE_PX = 0.5
"""OpenCV counts from the centre of the first pixel, marks from its corner."""


def refined(grey: NDArray[Any], col: float, row: float) -> tuple[float, float] | None:
    """Col and row of the corner nearest to a mark; None where there is none within a few pixels.

    The corner is where all gradients of its surroundings are perpendicular to the direction to it. It counts
    if windows of two sizes agree.

    Args: grey: one band (rows, cols) of a frame. Reference: Foerstner and Guelch 1987.
    """
    margin = max(_REACHES_PX) + int(np.ceil(_MOST_MOVE_PX)) + 2
    left, top = int(col) - margin, int(row) - margin
    part = grey[max(top, 0) : top + 2 * margin + 1, max(left, 0) : left + 2 * margin + 1]
    if min(part.shape, default=0) <= margin:
        return None
    if np.ptp(np.percentile(part, (5.0, 95.0))) < _LEAST_CONTRAST:
        return None
    origin = np.array([max(left, 0), max(top, 0)]) + _CENTRE_PX
    start = np.array([col, row]) - origin
    found = [_corner(part, start, reach) for reach in _REACHES_PX]
    apart, moved = np.linalg.norm(found[0] - found[1]), np.linalg.norm(found[1] - start)
    if not (apart <= _AGREE_PX and moved <= _MOST_MOVE_PX):
        return None
    return float(found[1][0] + origin[0]), float(found[1][1] + origin[1])


def _corner(part: NDArray[Any], start: Floats, reach: int) -> Floats:
    at = start.astype(np.float32).reshape(1, 1, 2)
    found = cv2.cornerSubPix(part.astype(np.float32), at, (reach, reach), (-1, -1), _ROUNDS)
    return np.asarray(found[0, 0], dtype=np.float64)
