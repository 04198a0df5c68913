"""The parts of the mosaic that a frame can't see for what stands before them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats32
from geomosaic.composition.window import Window


@dataclass(frozen=True)
class Hidden:
    """What one frame, an index into `Survey.frames`, can't see of the mosaic, by cells of side_px from its
    cell `row` and `col` on: height x width flags, packed. Side_px divides a planning cell's side."""

    frame: int
    side_px: int
    row: int
    col: int
    height: int
    width: int
    packed: Bytes

    @classmethod
    def of(cls, frame: int, side_px: int, row: int, col: int, flags: Bools) -> Hidden:
        """Packs flags (h, w)."""
        height, width = flags.shape
        return cls(frame, side_px, row, col, height, width, np.packbits(flags))

    @property
    def flags(self) -> Bools:
        """(h, w)."""
        flat = np.unpackbits(self.packed, count=self.height * self.width)
        return flat.reshape(self.height, self.width).view(bool)

    def within(self, window: Window) -> Bools:
        """Those of a window, (h, w) of their cells; what lies beyond them is not hidden."""
        side = self.side_px
        first = window.row // side - self.row, window.col // side - self.col
        found = np.zeros((-(-window.height // side), -(-window.width // side)), dtype=bool)
        own, at = [], []
        for begin, wanted, size in zip(first, found.shape, (self.height, self.width), strict=True):
            own.append(slice(max(begin, 0), max(min(begin + wanted, size), begin, 0)))
            at.append(slice(own[-1].start - begin, own[-1].stop - begin))
        found[at[0], at[1]] = self.flags[own[0], own[1]]
        return found

    def share(self, window: Window, cell_px: int) -> Floats32:
        """How much of a window's cells of cell_px, a multiple of side_px, is hidden, (h, w)."""
        by = cell_px // self.side_px
        flags = self.within(window).astype(np.float32)
        size = -(-flags.shape[1] // by), -(-flags.shape[0] // by)
        whole = cv2.copyMakeBorder(
            flags, 0, size[1] * by - flags.shape[0], 0, size[0] * by - flags.shape[1], cv2.BORDER_REPLICATE
        )
        return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), dtype=np.float32)

    def widened(self, cells: int) -> Hidden:
        """With so many cells more about them, or less where that is negative."""
        side = 2 * abs(cells) + 1
        change = cv2.dilate if cells > 0 else cv2.erode
        flags = change(self.flags.view(np.uint8), np.ones((side, side), np.uint8)) > 0
        return Hidden.of(self.frame, self.side_px, self.row, self.col, flags)


class Clear:
    """How far from what a frame can't see its pixels lie."""

    def __init__(self, hidden: Hidden) -> None:
        seen = (~hidden.flags).view(np.uint8)
        away = cv2.distanceTransform(seen, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        self._hidden, self._away_px = hidden, (away - np.float32(0.5)) * np.float32(hidden.side_px)

    def margin_px(self, window: Window) -> Floats32:
        """Of a window's pixels, (h, w), in px; above 0 wherever their own cell is seen. Between cells it is
        interpolated, and where cells of three frames meet no frame would have the corner."""
        side = self._hidden.side_px
        cols, rows = (
            ((np.arange(n, dtype=np.float32) + np.float32(first + 0.5)) / side - np.float32(begin + 0.5))
            for n, first, begin in (
                (window.width, window.col, self._hidden.col),
                (window.height, window.row, self._hidden.row),
            )
        )
        at = np.meshgrid(cols, rows)
        between, own = (
            cv2.remap(self._away_px, *at, how, borderMode=cv2.BORDER_REPLICATE)
            for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST)
        )
        np.maximum(between, np.float32(0.5), out=between, where=own > 0.0)
        return np.asarray(between, dtype=np.float32)
