"""Heights out of a DEM raster: only the window that a survey needs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.windows import Window, from_bounds
from scipy.ndimage import map_coordinates

from geomosaic.errors import FileError
from geomosaic.survey.model import ElevationModel

Floats = NDArray[np.float64]
_MOST_PIXELS = 6000


@dataclass(frozen=True)
class HeightRaster:
    """Ellipsoidal heights (rows, cols), NaN where unknown, of a north-up raster in some CRS.

    west, north: the outer corner of the first pixel; pixel_x, pixel_y > 0: its size, in CRS units.
    """

    height_ellipsoidal_m: Floats
    crs: str
    west: float
    north: float
    pixel_x: float
    pixel_y: float

    def at(self, x: Floats, y: Floats) -> Floats:
        """Bilinear between pixel centres; NaN outside and beside unknown pixels."""
        row = (self.north - y) / self.pixel_y - 0.5
        col = (x - self.west) / self.pixel_x - 0.5
        rows, cols = self.height_ellipsoidal_m.shape
        inside = (row > -0.5) & (row < rows - 0.5) & (col > -0.5) & (col < cols - 0.5)
        heights = map_coordinates(
            self.height_ellipsoidal_m, [row.ravel(), col.ravel()], order=1, mode="nearest"
        ).reshape(row.shape)
        return np.where(inside, heights, np.nan)


def dem_crs(elevation: ElevationModel) -> str:
    """The DEM's horizontal CRS as WKT."""
    with rasterio.open(elevation.path) as source:
        return str(source.crs.to_wkt())


def check_north_up(source: rasterio.DatasetReader, path: str | Path) -> None:
    """`FileError` for a raster that is turned or upside down."""
    t = source.transform
    if t.b != 0.0 or t.d != 0.0 or t.a <= 0.0 or t.e >= 0.0:
        raise FileError("the DEM is not north-up", file=path, mend="warp it with gdalwarp first")


def read_heights(elevation: ElevationModel, bounds: tuple[float, float, float, float]) -> HeightRaster:
    """The DEM's first band inside bounds (west, south, east, north in its own CRS), a pixel wider.

    A window of more than 6000 pixels a side is read reduced. Raises: FileError if nothing of the DEM
    lies inside the bounds, or it is not north-up.
    """
    with rasterio.open(elevation.path) as source:
        check_north_up(source, elevation.path)
        t = source.transform
        wanted = from_bounds(*bounds, transform=t)
        row_0, row_1 = np.clip(
            [np.floor(wanted.row_off) - 1, np.ceil(wanted.row_off + wanted.height) + 1], 0, source.height
        )
        col_0, col_1 = np.clip(
            [np.floor(wanted.col_off) - 1, np.ceil(wanted.col_off + wanted.width) + 1], 0, source.width
        )
        rows, cols = int(row_1 - row_0), int(col_1 - col_0)
        if rows < 1 or cols < 1:
            raise FileError(
                "the DEM does not cover the survey", file=elevation.path, mend="give one that does"
            )
        step = max(1.0, max(rows, cols) / _MOST_PIXELS)
        shape = (max(1, int(rows / step)), max(1, int(cols / step)))
        window = Window(int(col_0), int(row_0), cols, rows)
        band = source.read(1, window=window, out_shape=shape, masked=True, resampling=Resampling.average)
        heights = band.astype(np.float64).filled(np.nan) + elevation.offset_m
        return HeightRaster(
            height_ellipsoidal_m=heights,
            crs=source.crs.to_wkt(),
            west=t.c + col_0 * t.a,
            north=t.f + row_0 * t.e,
            pixel_x=t.a * cols / shape[1],
            pixel_y=-t.e * rows / shape[0],
        )
