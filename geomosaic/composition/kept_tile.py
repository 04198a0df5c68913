"""A tile of an earlier mosaic as a window of the present one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window as RasterWindow

from geomosaic.arrays import Bools, Ints64
from geomosaic.composition.window import Composed, Window
from geomosaic.doors.raster import OWN, open_raster


@dataclass(frozen=True)
class KeptTile:
    """A tile of an earlier mosaic.

    raster, sources: its files. col, row: its first column and row there. numbers: of each source of the
    earlier mosaic, from 1, its present number, from 0, or -1.
    """

    raster: Path
    sources: Path
    col: int
    row: int
    numbers: Ints64

    def read(self, window: Window) -> TilePixels:
        """The tile's content, of a window's size. The run reads it: its workers may not see the files."""
        at = RasterWindow(self.col, self.row, window.width, window.height)
        with open_raster(self.raster, OWN) as raster:
            pixels, valid = _padded(raster, at), _padded(raster, at, mask=True)[0] > 0
        with open_raster(self.sources, OWN) as raster:
            return TilePixels(pixels, valid, _padded(raster, at)[0], self.numbers)


@dataclass(frozen=True)
class TilePixels:
    """What a tile of an earlier mosaic holds. pixels (bands, h, w); valid (h, w); given (h, w): the source of
    each pixel there, from 1. numbers: see `KeptTile`."""

    pixels: NDArray[Any]
    valid: Bools
    given: NDArray[Any]
    numbers: Ints64

    def composed(self, window: Window) -> Composed:
        """The tile as a window of the present mosaic."""
        valid = self.valid
        shown = np.where(valid, self.pixels, self.pixels.dtype.type(0))
        pixels = np.ascontiguousarray(np.moveaxis(shown, 0, -1))
        given = self.numbers[self.given[valid].astype(np.int64) - 1]
        numbers = np.unique(given)
        label = np.full(valid.shape, -1, dtype=np.int16)
        label[valid] = np.searchsorted(numbers, given)
        all_numbers = tuple(int(n) for n in numbers)
        return Composed(window, pixels, valid, label, all_numbers, all_numbers)


def _padded(raster: Any, at: RasterWindow, *, mask: bool = False) -> NDArray[Any]:
    """A window's pixels, 0 beyond the raster's edge."""
    height, width = min(at.height, raster.height - at.row_off), min(at.width, raster.width - at.col_off)
    inner = RasterWindow(at.col_off, at.row_off, width, height)
    found = raster.dataset_mask(window=inner)[None] if mask else raster.read(window=inner)
    return np.pad(found, ((0, 0), (0, at.height - height), (0, at.width - width)))
