"""Rasters of a run on the pixel grid of one map, read tile by tile."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray
from rasterio import Affine
from rasterio.enums import ColorInterp, Resampling
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from geomosaic.arrays import Bools, Floats
from geomosaic.doors.raster import OWN, open_raster, reading, unreferenced_is_fine
from geomosaic.geodesy.mapcrs import in_local_frame
from geomosaic.quality.rasters import mask_of

TILE_PX: Final = 512


@dataclass(frozen=True)
class ViewGrid:
    """The pixels of a map: its CRS as WKT, empty where it has none, its geotransform and its size."""

    crs: str
    transform: Affine
    width: int
    height: int

    @classmethod
    def of(cls, path: Path) -> Self:
        """The grid of a raster. Raises: `FileError` for what is none."""
        with open_raster(path, OWN) as raster:
            crs = "" if raster.crs is None else raster.crs.to_wkt()
            return cls(crs, raster.transform, raster.width, raster.height)

    @property
    def on_earth(self) -> bool:
        """Whether the map has a place on the Earth, and so metres."""
        return bool(self.crs) and not in_local_frame(self.crs)

    @property
    def pixel_m(self) -> float:
        """The side of a pixel, in units of the map."""
        return float(self.transform.a)

    def map_from_px(self, px: Floats) -> Floats:
        """Places (n, 2) on the map of columns and rows (n, 2)."""
        of = self.transform
        return np.column_stack([of.c + of.a * px[:, 0], of.f + of.e * px[:, 1]])

    def px_from_map(self, map_m: Floats) -> Floats:
        """Columns and rows (n, 2) of places (n, 2) on the map."""
        of = self.transform
        return np.column_stack([(map_m[:, 0] - of.c) / of.a, (map_m[:, 1] - of.f) / of.e])

    def window(self, reduction: int, across: int, down: int, margin: int = 0) -> Window | None:
        """The map's pixels in a tile of TILE_PX pixels a side, each of `reduction` of the map's a side. The
        tile is grown by a margin of its pixels, as far as the map goes. None beyond the map."""
        side, more = TILE_PX * reduction, margin * reduction
        left, top = across * side, down * side
        if min(across, down) < 0 or left >= self.width or top >= self.height:
            return None
        first = max(left - more, 0), max(top - more, 0)
        last = min(left + side + more, self.width), min(top + side + more, self.height)
        return Window(*first, last[0] - first[0], last[1] - first[1])


class GridRaster:
    """A raster as seen on a grid: its own pixels where it has that grid, else resampled. May be asked from
    several threads.

    Raises: `FileError` where it cannot be read.
    """

    def __init__(self, path: Path, grid: ViewGrid) -> None:
        self._path, self._lock = path, threading.Lock()
        raster = open_raster(path, OWN)
        if ViewGrid.of(path) == grid:
            self._raster: Any = raster
        else:
            opaque = raster.nodata is None and ColorInterp.alpha not in raster.colorinterp
            self._raster = WarpedVRT(
                raster, crs=grid.crs, transform=grid.transform, width=grid.width, height=grid.height,
                resampling=Resampling.bilinear, add_alpha=opaque, warp_mem_limit=64,
            )  # fmt: skip

    def read(self, bands: Sequence[int], window: Window, reduction: int) -> tuple[NDArray[Any], Bools]:
        """Bands (bands, rows, cols) of a window, means of reduction x reduction pixels, and which pixels are
        known (rows, cols)."""
        shape = -(-int(window.height) // reduction), -(-int(window.width) // reduction)
        with self._lock, unreferenced_is_fine(), reading(self._path, OWN.problem, OWN.fix):
            how = {"window": window, "resampling": Resampling.average}
            values = self._raster.read(list(bands), out_shape=(len(bands), *shape), **how)
            known = mask_of(self._raster, window, shape) > 0
        return values, known
