"""Where heights leap: which side of a step a cell is on, and how crowns are rounded.

Windows that tell places apart reach over a step, so that roofs grow and crowns are cut. Here small windows
choose between few heights. These are a cell's own height, and the lowest and highest of the sure cells
around. Then come some a little up or down, along the surface as it leans.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import cv2
import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats32
from geomosaic.constants import sourced, tuned
from geomosaic.surface.refinement import SIDE_CELLS, SURE
from geomosaic.surface.squares import Squares, SquareView, SweptPictures, by_first, dense
from geomosaic.surface.visibility import Asked, hidden_from

_REACH_CELLS = sourced(6, "cells", "reach of offers", "wrong wall edges: 2: 26 %, 4: 22 %, 6 to 10: 18 %")
AROUND_CELLS: Final = 2 * _REACH_CELLS + 1
"""Side of a window: the reach both ways and the cell itself."""
STEP_CELLS = tuned(2.5, "cells", "range that makes a step: less is slope and noise; 4 loses 1.5 % of crowns")
_MOVES_CELLS = tuned(((0.0, -2.0, 2.0), (0.0, -2.0, 2.0), (0.0, -1.0, 1.0)), "cells", "moves tried by round")
_MOST_GREY = tuned(30, "grey levels", "cap, and value where unseen: higher lets single pixels decide")
_KEPT_GREY = tuned(0.5, "grey levels", "gain that another height needs: 0 lets noise move cells")
_DENSER: Final = 2
"""Windows' pixels along a cell's side."""
_RIM_CELLS: Final = SIDE_CELLS // 2 // _DENSER + 2
"""Reach of windows past a square."""
REFINED_CELLS: Final = _REACH_CELLS + _RIM_CELLS
"""Reach of all that is refined."""
_FAR_M: Final = np.float32(1e6)


def refine_edges(swept: SweptPictures, height_m: Floats32, alike: Floats32, asked: Asked) -> Floats32:
    """Heights over the base (rows, cols), where they leap by what small windows show.

    Args: height_m, alike (rows, cols): see `refined`; asked: blocks of cells, and the frames that are asked
    there.
    """
    sure, cell_m = alike >= SURE, swept.sweep.cells.cell_m
    window = np.ones((AROUND_CELLS, AROUND_CELLS), dtype=np.uint8)
    lowest = cv2.erode(np.where(sure, height_m, _FAR_M), window)
    highest = cv2.dilate(np.where(sure, height_m, -_FAR_M), window)
    lowest, highest = (np.where(abs(a) < _FAR_M, a, height_m).astype(np.float32) for a in (lowest, highest))
    leaping = highest - lowest > STEP_CELLS * cell_m
    blocks = [(at, frames) for at, frames in asked if leaping[at].any()]
    squares = Squares(swept.sweep, swept.pictures, blocks, _RIM_CELLS)
    if not len(squares):
        return height_m
    land_m = np.where(sure, height_m, np.minimum(lowest, height_m)).astype(np.float32)
    hidden_m = hidden_from(swept.sweep, blocks, land_m, cell_m)
    for k, moves in enumerate(((), *_MOVES_CELLS)):
        moved = height_m.copy()
        if k == 0:
            offers = np.stack([height_m, lowest, highest])
        else:
            offers = height_m + np.array(moves, dtype=np.float32)[:, None, None] * np.float32(cell_m)
        for some in squares.some(len(offers) * _DENSER**2):
            offered = some.cut(offers)
            differing = _differences(some, offered, hidden_m, lean=k > 0)
            differing[:, 0] -= _KEPT_GREY
            best = differing.argmin(axis=1)[:, None]
            some.put(np.take_along_axis(offered, best, axis=1)[:, 0], moved)
        moved = np.where(leaping, moved, height_m)
        height_m = np.asarray(cv2.medianBlur(moved, 3), dtype=np.float32)
    return height_m


def _differences(
    squares: Squares, offered_m: Floats32, hidden_m: Mapping[int, Floats32], lean: bool
) -> Floats32:
    """Grey levels (n, heights, rows, cols) by which the two frames most like the first that sees a place
    differ from it. offered_m: as many heights over the base; lean: they are a surface's."""
    dense_m = dense(offered_m, _DENSER, cv2.INTER_LINEAR if lean else cv2.INTER_NEAREST)
    sums = _two_most_alike(squares.shown(dense_m, hidden_m, _DENSER))
    *more, rows, cols = sums.shape
    size = cols // _DENSER, int(np.prod(more)) * rows // _DENSER
    found = cv2.resize(0.5 * sums.reshape(-1, cols).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    if lean:
        found = cv2.blur(found, (3, 3))
    return np.asarray(found, dtype=np.float32).reshape(offered_m.shape)


def _two_most_alike(shown: Sequence[SquareView]) -> Bytes:
    """The sum of the two least differences with the first frame that sees a place."""
    first, others = by_first(shown)
    window = SIDE_CELLS, SIDE_CELLS
    least, second = (np.full(first.shape, _MOST_GREY, dtype=np.uint8) for _ in range(2))
    for grey, sees in others:
        if sees is not None and not sees.any():
            continue
        apart = cv2.absdiff(_flat(first), _flat(_balanced(grey, first, sees)))
        apart = cv2.blur(np.minimum(apart, np.uint8(_MOST_GREY)), window).reshape(first.shape)
        if sees is not None:
            np.copyto(apart, np.uint8(_MOST_GREY), where=~sees)
        np.minimum(second, np.maximum(least, apart), out=second)
        np.minimum(least, apart, out=least)
    return np.asarray(least + second, dtype=np.uint8)


def _balanced(grey: Bytes, first: Bytes, sees: Bools | None) -> Bytes:
    """What a frame shows, each square (n, ...) as bright as the first one's where the frame sees it."""
    found = np.empty_like(grey)
    for k in range(len(grey)):
        mask = None if sees is None else _flat(sees[k].view(np.uint8))
        mean, own_mean = (cv2.mean(_flat(a[k]), mask)[0] for a in (first, grey))
        cv2.convertScaleAbs(_flat(grey[k]), _flat(found[k]), alpha=mean / own_mean if own_mean else 0.0)
    return found


def _flat(values: Bytes) -> Bytes:
    return values.reshape(-1, values.shape[-1])
