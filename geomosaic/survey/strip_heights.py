"""Heights under CCD strips, out of a DEM of any size: tiles of it are read as they are asked for."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
from typing import Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.doors.raster import DEM, open_raster
from geomosaic.errors import InputError
from geomosaic.geodesy.heights import ellipsoidal_offset_m, vertical_crs
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.dem import HeightRaster, outliers_warning, read_heights
from geomosaic.survey.elevation import check_dem
from geomosaic.survey.model import ElevationModel, Warn

_TILE_PX = tuned(256, "px a side", "read at once: smaller are many reads; larger hold unused land")
_MOST_TILES = tuned(384, "tiles", "kept, 200 MB: fewer are read again in a wide scene; more take memory")
_FIX: Final = "give a DEM of the whole scene, or leave 'dem' out"


@dataclass(eq=False)
class DemHeights:
    """Ellipsoidal heights at longitudes and latitudes: bilinear between the DEM's pixels.

    Unknown pixels take the nearest known one's height within their tile, a tile without any mean_m; beyond
    the DEM its edge goes on. fill False: mean_m for all unknown pixels. span_m: the lowest and the highest
    ground where the scene was sampled.
    """

    elevation: ElevationModel
    projection: MapProjection
    bounds: tuple[float, float, float, float]
    pixel: tuple[float, float]
    mean_m: float = 0.0
    span_m: tuple[float, float] = (0.0, 0.0)
    warnings: tuple[Warn, ...] = ()
    outliers: tuple[tuple[float, int], ...] = ()
    fill: bool = True
    _tiles: OrderedDict[tuple[int, int], HeightRaster | None] = field(default_factory=OrderedDict)
    _lock: Lock = field(default_factory=Lock)

    def __call__(self, lon_deg: Floats, lat_deg: Floats) -> Floats:
        """Heights (m) at places of any shape."""
        lon = np.asarray(lon_deg, dtype=np.float64)
        xy = self.projection.map_from_geodetic(lon, lat_deg).reshape(-1, 2)
        west, south, east, north = self.bounds
        spare = 1e-6 * np.array(self.pixel)
        x, y = np.clip(xy, np.array([west, south]) + spare, np.array([east, north]) - spare).T
        # fmax: a place that no map has, NaN, is of some tile too
        col, row = (
            np.fmax(np.floor(v), 0.0).astype(np.int64)
            for v in ((x - west) / (_TILE_PX * self.pixel[0]), (north - y) / (_TILE_PX * self.pixel[1]))
        )
        out = np.empty(x.size)
        number = (row << 32) + col
        for tile in np.unique(number):
            of_it = number == tile
            raster = self._tile(int(tile >> 32), int(tile & 0xFFFFFFFF))
            out[of_it] = self.mean_m if raster is None else raster.at(x[of_it], y[of_it])
        return np.where(np.isnan(out), self.mean_m, out).reshape(lon.shape)

    def _tile(self, row: int, col: int) -> HeightRaster | None:
        with self._lock:
            if (row, col) in self._tiles:
                self._tiles.move_to_end((row, col))
                return self._tiles[row, col]
            west, south, east, north = self.bounds
            width, height = _TILE_PX * self.pixel[0], _TILE_PX * self.pixel[1]
            left, top = west + col * width, north - row * height
            at = left, max(top - height, south), min(left + width, east), top
            read = read_heights(self.elevation, at)
            self.outliers += read.outliers
            raster = read.filled() if self.fill else read
            self._tiles[row, col] = raster
            if len(self._tiles) > _MOST_TILES:
                self._tiles.popitem(last=False)
            return raster


def read_dem_heights(path: Path, lonlat: Floats) -> DemHeights:
    """The heights of a DEM under a scene that is sampled by places (n, 2), in degrees.

    The vertical datum is the DEM's own, if its CRS states one; else its heights are taken for ellipsoidal,
    with a warning. Another warning says how much of the scene it doesn't cover.
    Raises: `InputError` if it covers none of the places or has no heights there, or its datum isn't usable.
    """
    path = path.absolute()
    crs, bounds = check_dem(path)
    projection = MapProjection(crs.to_wkt())
    xy = projection.map_from_geodetic(*lonlat.T)
    low, high = np.array([bounds.left, bounds.bottom]), np.array([bounds.right, bounds.top])
    inside = ((xy >= low) & (xy <= high)).all(axis=1)
    if not inside.any():
        raise InputError("the DEM does not cover the strips", file=path, fix=_FIX)
    vertical, warnings = vertical_crs(crs), []
    if vertical is None:
        text = (
            f"{path.name}: no vertical datum, so its heights are taken as ellipsoidal: the scene may be "
            "shifted by parallax; give a 'dem' whose CRS has a vertical part"
        )
        warnings.append(Warn("dem-datum-assumed", "", text))
        model = ElevationModel(str(path), 0.0, "taken for ellipsoidal")
    else:
        try:
            offset_m = ellipsoidal_offset_m(vertical, *np.median(lonlat[inside], axis=0))
        except InputError as error:
            raise InputError(error.problem, file=path, fix=error.fix) from error
        model = ElevationModel(str(path), offset_m, f"{vertical.name}, offset {offset_m:+.2f} m")
    with open_raster(path, DEM) as dem:
        pixel = float(dem.transform.a), float(-dem.transform.e)
    heights = DemHeights(model, projection, tuple(bounds), pixel, np.nan)
    sampled = heights(*lonlat[inside].T)
    known = np.isfinite(sampled)
    if not known.any():
        raise InputError("the DEM has no heights under the strips", file=path, fix=_FIX)
    heights.mean_m = float(sampled[known].mean())
    heights.span_m = float(sampled[known].min()), float(sampled[known].max())
    unfilled = replace(heights, mean_m=np.nan, fill=False, _tiles=OrderedDict(), _lock=Lock())
    lacking = 1.0 - np.isfinite(unfilled(*lonlat[inside].T)).sum() / len(lonlat)
    if lacking > 0.0:
        text = (
            f"{path.name}: no heights for {100.0 * lacking:.0f} % of the scene, where the nearest are used: "
        )
        text += "it may be shifted there; give a 'dem' that covers it"
        warnings.append(Warn("dem-gaps", "", text))
    if heights.outliers:
        warnings.append(outliers_warning(heights.outliers, path))
    heights.warnings = tuple(warnings)
    return heights
