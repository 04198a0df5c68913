"""Where heights leap: which side of a step a cell is on, and how crowns are rounded.

Windows that tell places apart reach over a step, so that roofs grow and crowns are cut. Here small windows
choose between few heights: a cell's own, those of the sure cells around that are lowest and highest, then
some a little up or down, along the surface as it leans.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import CHOSEN, Because
from geomosaic.surface.verticals import Block, Verticals
from geomosaic.surface.visibility import Asked, hidden_from

Bytes = NDArray[np.uint8]
Floats32 = NDArray[np.float32]
_SIDES: Annotated[
    float,
    Because(
        "correlation",
        "of cells whose heights are offered to those around: of those above one in twenty is off by 1 m",
        "computed of two simulated towns: edges of walls off by more than 1 m 18 % with 0.7, 20 to 22 % with "
        "0.5",
    ),
] = 0.7
_AROUND_CELLS: Annotated[
    int,
    Because(
        "cells",
        "to every side from where heights are offered: what a wall hides is as wide",
        "computed of the same towns: edges off by more than 1 m 26 % with 2, 22 % with 4, 18 % with 6 to 10",
    ),
] = 6
_STEP_CELLS: Annotated[
    float,
    Because("cells", "between the lowest and the highest around, from which on heights leap", CHOSEN),
] = 2.5
_MOVES_CELLS: Annotated[
    tuple[tuple[float, ...], ...],
    Because(
        "cells",
        "of height that are offered in each round of moving up or down, its own first: with more, time grows",
        "computed of a simulated town: crowns off by more than 1 m 24 % with these, 23 % with four moves",
    ),
] = ((0.0, -2.0, 2.0), (0.0, -2.0, 2.0), (0.0, -1.0, 1.0))
_WINDOW: Annotated[
    int,
    Because(
        "half cells",
        "side of the windows: with more, corners are cut",
        "computed of the same towns: crowns off by more than 1 m 17 % with 3, 19 % with 5",
    ),
] = 3
_MOST_GREY: Annotated[
    int,
    Because("grey levels", "by which frames differ, at most: more says no more; and what isn't seen", CHOSEN),
] = 30
_KEPT_GREY: Annotated[
    float, Because("grey levels", "that another height must be better by, against noise", CHOSEN)
] = 0.5
_BLOCK_CELLS: Annotated[
    int,
    Because(
        "cells", "side of the squares that are looked at whole if a cell of them leaps: less work", CHOSEN
    ),
] = 32
_WIDER_CELLS: Annotated[int, Because("cells", "that windows reach past a square", "_WINDOW twice")] = 2
_FAR_M: Final = np.float32(1e6)


def sharpened(
    verticals: Verticals,
    cell_m: float,
    pictures: Sequence[Bytes],
    height_m: Floats32,
    alike: Floats32,
    asked: Asked,
) -> Floats32:
    """Heights over the base (rows, cols), where they leap by what small windows show.

    Args: cell_m: their side; pictures: grey, of the verticals' frames; height_m, alike (rows, cols): see
    `refined`; asked: blocks of cells, and the frames that are asked there.
    """
    sure = alike >= _SIDES
    window = np.ones((2 * _AROUND_CELLS + 1,) * 2, dtype=np.uint8)
    lowest = cv2.erode(np.where(sure, height_m, _FAR_M), window)
    highest = cv2.dilate(np.where(sure, height_m, -_FAR_M), window)
    lowest, highest = (np.where(abs(a) < _FAR_M, a, height_m).astype(np.float32) for a in (lowest, highest))
    leaping = highest - lowest > _STEP_CELLS * cell_m
    blocks = _leaping_blocks(leaping, asked)
    if not blocks:
        return height_m
    finer = _Finer(verticals, pictures)
    for k, moves in enumerate(((), *_MOVES_CELLS)):
        if k < 2:  # later rounds move what stands by less than hides anything else
            land_m = np.where(sure, height_m, np.minimum(lowest, height_m)).astype(np.float32)
            hidden_m = hidden_from(verticals, blocks, land_m, cell_m)
        moved = height_m.copy()
        for at, frames in blocks:
            wide = _widened(at, height_m.shape)
            if k == 0:
                offered = np.stack([a[wide] for a in (height_m, lowest, highest)])
            else:
                offered = np.stack([height_m[wide] + np.float32(by * cell_m) for by in moves])
            differing = finer.differing(offered, wide, frames, hidden_m, lean=k > 0)
            differing[0] -= _KEPT_GREY
            best = np.take_along_axis(offered, differing.argmin(axis=0)[None], axis=0)[0]
            inner = tuple(slice(s.start - w.start, s.stop - w.start) for s, w in zip(at, wide, strict=True))
            moved[at] = np.where(leaping[at], best[inner[0], inner[1]], height_m[at])
        height_m = np.asarray(cv2.medianBlur(moved, 3), dtype=np.float32)
    return height_m


def _leaping_blocks(leaping: NDArray[np.bool_], asked: Asked) -> list[tuple[Block, Sequence[int]]]:
    found = []
    for at, frames in asked:
        rows, cols = (slice(s.start, min(s.stop, n)) for s, n in zip(at, leaping.shape, strict=True))
        for top in range(rows.start, rows.stop, _BLOCK_CELLS):
            for left in range(cols.start, cols.stop, _BLOCK_CELLS):
                part = (
                    slice(top, min(top + _BLOCK_CELLS, rows.stop)),
                    slice(left, min(left + _BLOCK_CELLS, cols.stop)),
                )
                if len(frames) > 1 and leaping[part].any():
                    found.append((part, frames))
    return found


def _widened(at: Block, shape: tuple[int, ...]) -> Block:
    rows, cols = (
        slice(max(s.start - _WIDER_CELLS, 0), min(s.stop + _WIDER_CELLS, n))
        for s, n in zip(at, shape, strict=True)
    )
    return rows, cols


class _Finer:
    """The same verticals twice as dense each way, and what frames show there."""

    def __init__(self, verticals: Verticals, pictures: Sequence[Bytes]) -> None:
        self._verticals = verticals.finer(2)
        self._pictures = pictures

    def differing(
        self,
        offered_m: Floats32,
        at: Block,
        frames: Sequence[int],
        hidden_m: dict[int, Floats32],
        lean: bool,
    ) -> Floats32:
        """Grey levels (heights, rows, cols) by which the two frames most like the first that sees a place
        differ from it."""
        rows, cols = (slice(2 * s.start, 2 * s.stop) for s in at)
        interpolation = cv2.INTER_LINEAR if lean else cv2.INTER_NEAREST
        size = (cols.stop - cols.start, rows.stop - rows.start)
        dense_m = np.stack([cv2.resize(o, size, interpolation=interpolation) for o in offered_m])
        bent = self._verticals.bent(dense_m)
        shown, seen = [], []
        for k in frames:
            col, row = (a.reshape(-1, size[0]) for a in self._verticals.places(k, bent, (rows, cols)))
            low_m = hidden_m[k][at]
            sees = _inside(col, row, self._pictures[k].shape)
            if not low_m.max() <= dense_m.min():
                dense_low_m = cv2.resize(low_m, size, interpolation=cv2.INTER_NEAREST)
                unhidden = (dense_m >= dense_low_m).reshape(col.shape)
                sees = unhidden if sees is None else sees & unhidden
            border = cv2.BORDER_REPLICATE
            grey = cv2.remap(self._pictures[k], col, row, cv2.INTER_LINEAR, borderMode=border)
            shown.append(np.asarray(grey, dtype=np.uint8))
            seen.append(sees)
        sums = self._two_most_alike(shown, seen)
        own = (size[0] // 2, len(sums) // 2)
        found = cv2.resize(0.5 * sums.astype(np.float32), own, interpolation=cv2.INTER_AREA)
        if lean:
            found = cv2.blur(found, (3, 3))
        return np.asarray(found.reshape(len(offered_m), size[1] // 2, size[0] // 2), dtype=np.float32)

    def _two_most_alike(self, shown: Sequence[Bytes], seen: Sequence[NDArray[np.bool_] | None]) -> Bytes:
        """The sum of the two least differences with the first frame that sees a place (seen: None where all
        are); several heights lie one below the other, and are mixed at their rims, which nobody looks at."""
        first, others = shown[0], list(seen[1:])
        if seen[0] is not None:
            first, lacking = first.copy(), ~seen[0]
            for k, grey in enumerate(shown[1:]):
                if lacking.any():
                    sees = others[k]
                    own = lacking.copy() if sees is None else lacking & sees
                    np.copyto(first, grey, where=own)
                    lacking &= ~own
                    others[k] = ~own if sees is None else sees & ~own
        least, second = (np.full(first.shape, _MOST_GREY, dtype=np.uint8) for _ in range(2))
        for grey, other in zip(shown[1:], others, strict=True):
            mask = None if other is None else other.view(np.uint8)
            mean, own_mean = cv2.mean(first, mask)[0], cv2.mean(grey, mask)[0]
            if own_mean <= 0.0:
                continue
            apart = cv2.absdiff(first, cv2.convertScaleAbs(grey, alpha=mean / own_mean))
            apart = cv2.blur(np.minimum(apart, np.uint8(_MOST_GREY)), (_WINDOW, _WINDOW))
            if other is not None:
                np.copyto(apart, np.uint8(_MOST_GREY), where=~other)
            np.minimum(second, np.maximum(least, apart), out=second)
            np.minimum(least, apart, out=least)
        return np.asarray(least + second, dtype=np.uint8)


def _inside(col: Floats32, row: Floats32, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
    """Which places lie in a picture; None where all do."""
    down, across = shape
    if col.min() >= 0.0 and col.max() < across - 1.0 and row.min() >= 0.0 and row.max() < down - 1.0:
        return None
    return np.asarray((col >= 0.0) & (col < across - 1.0) & (row >= 0.0) & (row < down - 1.0))
