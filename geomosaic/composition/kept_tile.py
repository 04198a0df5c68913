"""A tile of an earlier mosaic as a window of the present one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window as RasterWindow

from geomosaic.arrays import Ints64
from geomosaic.composition.window import Composed, Window
from geomosaic.doors.at_hand import at_hand
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

    def composed(self, window: Window) -> Composed:
        """The tile as a window of the present mosaic."""
        at = RasterWindow(self.col, self.row, window.width, window.height)
        with open_raster(at_hand(self.raster), OWN) as raster:
            pixels = np.ascontiguousarray(np.moveaxis(_padded(raster, at), 0, -1))
            valid = _padded(raster, at, mask=True)[0] > 0
        with open_raster(at_hand(self.sources), OWN) as raster:
            given = np.where(valid, _padded(raster, at)[0].astype(np.int64), 0)
        numbers = np.unique(self.numbers[given[valid] - 1])
        label = np.full(valid.shape, -1, dtype=np.int16)
        label[valid] = np.searchsorted(numbers, self.numbers[given[valid] - 1])
        pixels[~valid] = 0
        all_numbers = tuple(int(n) for n in numbers)
        return Composed(window, pixels, valid, label, all_numbers, all_numbers)


def _padded(raster: Any, at: RasterWindow, *, mask: bool = False) -> NDArray[Any]:
    """A window's pixels, 0 beyond the raster's edge."""
    height, width = min(at.height, raster.height - at.row_off), min(at.width, raster.width - at.col_off)
    inner = RasterWindow(at.col_off, at.row_off, width, height)
    found = raster.dataset_mask(window=inner)[None] if mask else raster.read(window=inner)
    return np.pad(found, ((0, 0), (0, at.height - height), (0, at.width - width)))
