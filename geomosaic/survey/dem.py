"""Heights out of a DEM raster: only the window that a survey needs, and no finer than it needs it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS
from rasterio import Env
from rasterio.enums import Resampling
from rasterio.windows import Window, from_bounds
from scipy.ndimage import distance_transform_edt, map_coordinates

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.doors.raster import DEM, READ_CACHE_BYTES, Raster, open_raster, reading
from geomosaic.errors import FileError
from geomosaic.geodesy.heights import length_m, raster_unit_m
from geomosaic.survey.dem_outliers import outliers
from geomosaic.survey.model import ElevationModel, Warn

MOST_PIXELS = tuned(2000, "px a side", "as many as the ground has nodes: fewer lose relief; more are unused")
_AROUND = tuned(32, "px", "next to the window, to judge it by: less misses fills and spikes at its edge")


@dataclass(frozen=True)
class HeightRaster:
    """Ellipsoidal heights (rows, cols), NaN where unknown, of a north-up raster in some CRS.

    west, north: the outer corner of the first pixel; pixel_x, pixel_y > 0: its size, in CRS units.
    outliers: values (m, as the file has them) that no neighbour bears out and that count as unknown, with
    how many there are of each.
    """

    height_ellipsoidal_m: Floats
    crs: str
    west: float
    north: float
    pixel_x: float
    pixel_y: float
    outliers: tuple[tuple[float, int], ...] = ()

    @property
    def middle_x(self) -> float:
        """Halfway from its western to its eastern edge."""
        return float(self.west + self.height_ellipsoidal_m.shape[1] * self.pixel_x / 2.0)

    def at(self, x: Floats, y: Floats) -> Floats:
        """Bilinear between pixel centres; NaN outside and next to unknown pixels."""
        row = (self.north - y) / self.pixel_y - 0.5
        col = (x - self.west) / self.pixel_x - 0.5
        rows, cols = self.height_ellipsoidal_m.shape
        inside = (row > -0.5) & (row < rows - 0.5) & (col > -0.5) & (col < cols - 0.5)
        heights = map_coordinates(
            self.height_ellipsoidal_m, [row.ravel(), col.ravel()], order=1, mode="nearest"
        ).reshape(row.shape)
        return np.where(inside, heights, np.nan)

    def nearest(self, x: Floats, y: Floats) -> Floats:
        """As `at`, with the edge's heights beyond it."""
        rows, cols = self.height_ellipsoidal_m.shape
        half_x, half_y = self.pixel_x / 2.0, self.pixel_y / 2.0
        return self.at(
            np.clip(x, self.west + half_x, self.west + cols * self.pixel_x - half_x),
            np.clip(y, self.north - rows * self.pixel_y + half_y, self.north - half_y),
        )

    def filled(self) -> HeightRaster | None:
        """With the nearest known height where one is unknown; None where none is known."""
        unknown = np.isnan(self.height_ellipsoidal_m)
        if unknown.all():
            return None
        if not unknown.any():
            return self
        nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
        return replace(self, height_ellipsoidal_m=self.height_ellipsoidal_m[tuple(nearest)])


def outliers_warning(found: tuple[tuple[float, int], ...], path: Path) -> Warn:
    """What a DEM's outliers are said to be."""
    count = sum(n for _, n in found)
    values = ", ".join(f"{value:g} m ({n:,} times)" for value, n in found[:3])
    more = f" and {len(found) - 3} other values" if len(found) > 3 else ""
    text = (
        f"{count:,} heights far from all around them are treated as no data: {values}{more}; nothing to do "
    )
    text += "if they mark gaps, else correct them in the file"
    return Warn("dem-outliers", "", f"{path.name}: {text}")


def dem_crs(elevation: ElevationModel) -> str:
    """The DEM's horizontal CRS as WKT."""
    with open_raster(Path(elevation.path), DEM) as source:
        return str(source.crs.to_wkt())


def dem_middle_x(elevation: ElevationModel) -> float:
    """Halfway from the DEM's western to its eastern edge, in its CRS."""
    with open_raster(Path(elevation.path), DEM) as source:
        return float(source.bounds.left + source.bounds.right) / 2.0


def check_grid(source: Raster, path: Path) -> None:
    """`FileError` for a raster that is turned or upside down, or whose values are no heights."""
    t = source.transform
    if not np.isfinite([*t, *source.bounds]).all():
        raise FileError("the DEM's georeference is no number", file=path, fix="correct its georeference")
    if t.b != 0.0 or t.d != 0.0 or t.a <= 0.0 or t.e >= 0.0:
        raise FileError("the DEM is not north-up", file=path, fix="warp it with gdalwarp first")
    if np.dtype(source.dtypes[0]).kind not in "iuf":
        problem = f"the DEM's values are {source.dtypes[0]}"
        raise FileError(problem, file=path, fix="give a DEM of real or whole numbers")
    if source.units[0] and length_m(source.units[0]) is None:
        problem = f"the DEM's heights are in {source.units[0]}"
        raise FileError(problem, file=path, fix="convert them to metres or feet")
    if not np.isfinite([source.scales[0], source.offsets[0]]).all() or source.scales[0] == 0.0:
        problem = f"the DEM's scale is {source.scales[0]:g}, its offset {source.offsets[0]:g}"
        raise FileError(problem, file=path, fix="correct them (gdal_edit.py -scale 1 -offset 0)")


def read_heights(
    elevation: ElevationModel, bounds: tuple[float, float, float, float], finest: float = 0.0
) -> HeightRaster:
    """The DEM's first band inside bounds (west, south, east, north in its own CRS), a pixel wider.

    It is read reduced to pixels of at least `finest` (CRS units), and to 2000 pixels a side. Scale and
    offset of the band are applied, and values that can't be heights are unknown.
    Raises: FileError if nothing of the DEM lies inside the bounds, or it can't be read.
    """
    path = Path(elevation.path)
    with Env(GDAL_CACHEMAX=READ_CACHE_BYTES), open_raster(path, DEM) as source, reading(path):
        check_grid(source, path)
        wanted = _window(source, bounds, (1, 1))
        if wanted is None:
            fix = "give a DEM of the whole survey"
            raise FileError("the DEM does not cover the survey", file=path, fix=fix)
        t, sides = source.transform, (wanted.height, wanted.width)
        pixels = zip(sides, (-t.e, t.a), strict=True)
        steps = [max(1.0, side / MOST_PIXELS, finest / pixel) for side, pixel in pixels]
        window = _window(source, bounds, (int(steps[0] * _AROUND), int(steps[1] * _AROUND))) or wanted
        sides = (window.height, window.width)
        shape = tuple(max(1, int(side / step)) for side, step in zip(sides, steps, strict=True))
        reduced = shape != sides
        heights = _read(source, window, shape, Resampling.average if reduced else Resampling.nearest)
        bad = outliers(heights + elevation.offset_m, reduced)
        if reduced and bad.any():  # the means hold mixtures of what is a height and what is none
            heights = _read(source, window, shape, Resampling.nearest)
            bad = outliers(heights + elevation.offset_m, reduced)
        rows, step_y = _part(window.row_off, window.height, wanted.row_off, wanted.height, shape[0])
        cols, step_x = _part(window.col_off, window.width, wanted.col_off, wanted.width, shape[1])
        heights, bad = heights[rows, cols], bad[rows, cols]
        outlying = _counted(heights[bad])
        heights[bad] = np.nan
        return HeightRaster(
            height_ellipsoidal_m=heights + elevation.offset_m,
            crs=source.crs.to_wkt(),
            west=t.c + (window.col_off + cols.start * step_x) * t.a,
            north=t.f + (window.row_off + rows.start * step_y) * t.e,
            pixel_x=t.a * step_x,
            pixel_y=-t.e * step_y,
            outliers=outlying,
        )


def _window(
    source: Raster, bounds: tuple[float, float, float, float], around: tuple[int, int]
) -> Window | None:
    """Whole pixels (and rows and cols more) around bounds, as far as the raster goes; None without any."""
    if not np.isfinite(bounds).all():
        return None
    wanted = from_bounds(*bounds, transform=source.transform)
    rows = wanted.row_off + np.array([0.0, wanted.height])
    cols = wanted.col_off + np.array([0.0, wanted.width])
    row_0, row_1 = np.clip([np.floor(rows[0]) - around[0], np.ceil(rows[1]) + around[0]], 0, source.height)
    col_0, col_1 = np.clip([np.floor(cols[0]) - around[1], np.ceil(cols[1]) + around[1]], 0, source.width)
    if row_1 - row_0 < 1 or col_1 - col_0 < 1:
        return None
    return Window(int(col_0), int(row_0), int(col_1 - col_0), int(row_1 - row_0))


def _part(start: int, size: int, wanted_start: int, wanted_size: int, count: int) -> tuple[slice, float]:
    """Which of count rows (or cols) that stand for size pixels hold the wanted ones; the pixels of one."""
    step = size / count
    first = int((wanted_start - start) / step)
    return slice(first, int(np.ceil((wanted_start - start + wanted_size) / step))), step


def _read(source: Raster, window: Window, shape: tuple[int, ...], how: Resampling) -> Floats:
    """Heights in metres as the band's scale and offset have them, NaN where there are none."""
    band = source.read(1, window=window, out_shape=shape, masked=True, resampling=how)
    heights = band.astype(np.float64).filled(np.nan) * source.scales[0] + source.offsets[0]
    heights[~np.isfinite(heights)] = np.nan
    unit_m = raster_unit_m(source.units[0], CRS.from_wkt(source.crs.to_wkt()))
    return np.asarray(heights * unit_m)


def _counted(values: Floats) -> tuple[tuple[float, int], ...]:
    """Each value and how often it is there, the most frequent first; the first hundred."""
    unique, counts = np.unique(values, return_counts=True)
    order = np.argsort(-counts, kind="stable")[:100]
    return tuple((float(unique[i]), int(counts[i])) for i in order)
