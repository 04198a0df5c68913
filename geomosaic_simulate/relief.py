"""The ground's heights: level, hills from a seed, or a raster's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from geomosaic.arrays import Floats
from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.dem import dem_crs, read_heights
from geomosaic.survey.elevation import read_elevation
from geomosaic_simulate.noise import spline_noise

_SMOOTH_PX = 20
_MOST_NODES = 4000


@dataclass(frozen=True)
class Relief:
    """Ellipsoidal height of the ground: level, or hills of one wavelength with smooth (C2) slopes."""

    seed: int
    base_m: float
    amplitude_m: float = 0.0
    wavelength_m: float = 300.0

    @property
    def detail_m(self) -> float:
        """The size of the smallest detail."""
        return self.wavelength_m

    @property
    def mesh_m(self) -> float:
        """The spacing at which the relief is as good as linear: chords are off by about a millimetre."""
        return min(self.wavelength_m / 300.0, 2.0)

    def height_at(self, easting_m: ArrayLike, northing_m: ArrayLike) -> Floats:
        """Ellipsoidal height (m) at map coordinates of any shape."""
        east, north = np.broadcast_arrays(np.asarray(easting_m, float), np.asarray(northing_m, float))
        if self.amplitude_m == 0.0:
            return np.full(east.shape, self.base_m)
        node = self.wavelength_m / 2.0
        hills = spline_noise(self.seed, 900, east / node, north / node)
        return np.asarray(self.base_m + self.amplitude_m * (hills - 0.5))


def hills(seed: int, mean_m: float, relief_m: float, wavelength_m: float, at_m: Floats) -> Relief:
    """Relief whose lowest and highest ground among at_m (..., 2) are relief_m apart, mean_m between."""
    if relief_m == 0.0:
        return Relief(seed, mean_m)
    raw = Relief(seed, 0.0, 1.0, wavelength_m).height_at(at_m[..., 0], at_m[..., 1])
    amplitude = relief_m / float(raw.max() - raw.min())
    return Relief(seed, mean_m - amplitude * float(raw.max() + raw.min()) / 2.0, amplitude, wavelength_m)


@dataclass(frozen=True, eq=False)
class RasterRelief:
    """A raster's heights on a grid of the map, made smooth (C2) by a cubic B-spline over its nodes.

    height_m: (rows, cols) at nodes detail_m apart, the first at west_m, south_m, rows northward. Outside
    the grid its edge goes on.
    """

    west_m: float
    south_m: float
    detail_m: float
    height_m: Floats

    @property
    def base_m(self) -> float:
        """The middle between the lowest and the highest node."""
        return float(self.height_m.max() + self.height_m.min()) / 2.0

    @property
    def amplitude_m(self) -> float:
        """At least the highest minus the lowest ground."""
        return float(np.ptp(self.height_m))

    @property
    def mesh_m(self) -> float:
        """The spacing at which the relief is as good as linear."""
        return min(self.detail_m / 8.0, 2.0)

    def height_at(self, easting_m: ArrayLike, northing_m: ArrayLike) -> Floats:
        """Ellipsoidal height (m) at map coordinates of any shape."""
        east, north = np.broadcast_arrays(np.asarray(easting_m, float), np.asarray(northing_m, float))
        at = np.stack([(north - self.south_m).ravel(), (east - self.west_m).ravel()]) / self.detail_m
        height = map_coordinates(self.height_m, at, order=3, prefilter=False, mode="nearest")
        return np.asarray(height).reshape(east.shape)


def raster_height_m(dem: Path, lon_deg: float, lat_deg: float) -> float:
    """A DEM's height at a place, ellipsoidal as far as its CRS states (see `survey.elevation`).

    Raises: `InputError` or `FileError` for what is no DEM or doesn't reach there.
    """
    _, heights, _ = read_elevation(dem, None, ["the survey's middle"], np.array([[lon_deg, lat_deg]]))
    return float(heights[0])


def raster_relief(
    dem: Path,
    middle_deg: tuple[float, float],
    projection: MapProjection,
    bounds_m: tuple[float, float, float, float],
    pixel_m: float,
) -> RasterRelief:
    """The relief of a DEM within map bounds; details below 20 ground pixels are left out.

    Raises: `InputError` when the DEM doesn't cover the bounds.
    """
    model, _, _ = read_elevation(dem, None, ["the survey's middle"], np.array([middle_deg]))
    there = MapProjection(dem_crs(model))
    west, south, east, north = bounds_m

    def in_dem(e: Any, n: Any) -> Floats:
        lonlat = projection.geodetic_from_map(e, n)
        return there.map_from_geodetic(lonlat[..., 0], lonlat[..., 1])

    border = np.linspace(0.0, 1.0, 20)
    edge = in_dem(west + (east - west) * border[:, None], south + (north - south) * border)
    low, high = edge.reshape(-1, 2).min(axis=0), edge.reshape(-1, 2).max(axis=0)
    raster = read_heights(model, (float(low[0]), float(low[1]), float(high[0]), float(high[1])))
    across_m = float(np.hypot(east - west, north - south)) / float(np.hypot(*(high - low)))
    native_m = max(raster.pixel_x, raster.pixel_y) * across_m
    step = max(native_m, _SMOOTH_PX * pixel_m, max(east - west, north - south) / _MOST_NODES)
    e, n = np.meshgrid(np.arange(west, east + step, step), np.arange(south, north + step, step))
    xy = in_dem(e, n)
    heights = raster.at(xy[..., 0], xy[..., 1])
    if not np.isfinite(heights).all():
        lacking = 100.0 * float(np.mean(~np.isfinite(heights)))
        raise InputError(
            f"the DEM has no heights for {lacking:.0f} % of the survey",
            file=dem,
            fix="give a DEM that reaches further, or another lon_deg and lat_deg",
        )
    return RasterRelief(west, south, step, heights)
