"""Cells of the mosaic, by which it is planned what is asked of a frame, and the boxes they are asked in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import blake2b

import numpy as np

from geomosaic.arrays import Bools, Ints
from geomosaic.composition.scene import CELL_PX
from geomosaic.composition.window import Window
from geomosaic.constants import tuned

_WORTH_A_BOX = tuned(64, "cells", "saved by one more box: fewer make many boxes; more resample for nothing")


def window_cells(window: Window) -> tuple[int, int]:
    """How many cells a window has down and across."""
    return -(-window.height // CELL_PX), -(-window.width // CELL_PX)


@dataclass(frozen=True)
class MosaicCells:
    """Which of the mosaic's cells, CELL_PX a side, from row and col on, (h, w)."""

    row: int
    col: int
    flags: Bools

    @property
    def mark(self) -> tuple[int, int, str]:
        """What tells them from others."""
        shape = repr(self.flags.shape).encode()
        return self.row, self.col, blake2b(shape + self.flags.tobytes(), digest_size=16).hexdigest()

    @property
    def window(self) -> Window:
        """All about which it is said whether they are."""
        down, across = self.flags.shape
        return Window(self.col * CELL_PX, self.row * CELL_PX, across * CELL_PX, down * CELL_PX)

    def common(self, window: Window) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """What they have in common with a window's: counted from their own first cell, and from its first."""
        (high, wide), (down, across) = self.flags.shape, window_cells(window)
        row, col = window.row // CELL_PX - self.row, window.col // CELL_PX - self.col
        top, left = max(row, 0), max(col, 0)
        end, right = max(min(row + down, high), top), max(min(col + across, wide), left)
        own = slice(top, end), slice(left, right)
        return own, (slice(top - row, end - row), slice(left - col, right - col))

    def boxes(self, tile_px: int) -> Iterator[Window]:
        """Boxes that hold them all, each within a tile of tile_px, and none of them twice."""
        side, (down, across) = tile_px // CELL_PX, self.flags.shape
        for top in range(self.row // side * side - self.row, down, side):
            for left in range(self.col // side * side - self.col, across, side):
                tile = slice(max(top, 0), top + side), slice(max(left, 0), left + side)
                for rows, cols in _boxes(self.flags[tile], tile[0].start, tile[1].start):
                    yield Window(
                        (self.col + cols.start) * CELL_PX,
                        (self.row + rows.start) * CELL_PX,
                        (cols.stop - cols.start) * CELL_PX,
                        (rows.stop - rows.start) * CELL_PX,
                    )


def _boxes(flags: Bools, row: int, col: int) -> Iterator[tuple[slice, slice]]:
    """One box about all cells, cut in two along the best line as often as that is worth it. row, col: of the
    first cell."""
    if not flags.any():
        return
    rows, cols = (np.flatnonzero(flags.any(axis=axis)) for axis in (1, 0))
    row, col, flags = row + rows[0], col + cols[0], flags[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    cuts = [_areas(of)[:-1] + _areas(of[::-1])[-2::-1] for of in (flags, flags.T)]
    best = [int(of.min(initial=flags.size)) for of in cuts]
    if flags.size - np.count_nonzero(flags) < _WORTH_A_BOX or flags.size - min(best) < _WORTH_A_BOX:
        yield slice(int(row), int(row) + flags.shape[0]), slice(int(col), int(col) + flags.shape[1])
        return
    at = int(cuts[best.index(min(best))].argmin()) + 1
    if best[0] <= best[1]:
        yield from _boxes(flags[:at], row, col)
        yield from _boxes(flags[at:], row + at, col)
    else:
        yield from _boxes(flags[:, :at], row, col)
        yield from _boxes(flags[:, at:], row, col + at)


def _areas(flags: Bools) -> Ints:
    """Of the box about the cells of the first 1, 2, ... rows, the first of which has some."""
    used, (down, across) = flags.any(axis=1), flags.shape
    first = np.where(used, flags.argmax(axis=1), across)
    last = np.where(used, across - flags[:, ::-1].argmax(axis=1), 0)
    high = np.maximum.accumulate(np.where(used, np.arange(1, down + 1), 0))
    return np.asarray(high * (np.maximum.accumulate(last) - np.minimum.accumulate(first)))
