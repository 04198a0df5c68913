"""A north-up grid of pixels on the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats


@dataclass(frozen=True)
class MapGrid:
    """A north-up raster on the map: its CRS, upper left corner, ground pixel and size."""

    crs: str
    west_m: float
    north_m: float
    gsd_m: float
    width_px: int
    height_px: int

    @property
    def east_m(self) -> float:
        """The right edge's easting."""
        return self.west_m + self.width_px * self.gsd_m

    @property
    def south_m(self) -> float:
        """The lower edge's northing."""
        return self.north_m - self.height_px * self.gsd_m

    @property
    def geotransform(self) -> tuple[float, float, float, float, float, float]:
        """GDAL's six numbers: map from col and row with corner origin."""
        return self.west_m, self.gsd_m, 0.0, self.north_m, 0.0, -self.gsd_m

    def map_from_pixel(self, pixel: Floats) -> Floats:
        """Easting and northing (..., 2) of cols and rows (..., 2)."""
        return np.asarray([self.west_m, self.north_m] + np.asarray(pixel) * [self.gsd_m, -self.gsd_m])

    def part(self, row: int, col: int, size: tuple[int, int], step_px: int = 1) -> MapGrid:
        """The grid from a row and col on. size: rows and cols. step_px: pixels of this grid in one of it."""
        west_m, north_m = self.west_m + col * self.gsd_m, self.north_m - row * self.gsd_m
        return MapGrid(self.crs, west_m, north_m, self.gsd_m * step_px, size[1], size[0])
