"""A surface compared with a reference: heights of another raster, or of a point cloud."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from geomosaic.arrays import Bools, Floats, Floats32, Ints
from geomosaic.constants import tuned
from geomosaic.doors.raster import OWN, Raster, open_raster, reading
from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import check_on_earth
from geomosaic.quality.height_fit import HeightFit, fitted
from geomosaic.quality.heights import HeightFigures, by_class, height_figures, kind_names, slope_classes
from geomosaic.quality.reference_heights import ReferenceHeights, read_reference

_PICTURE_PX = tuned(700, "px", "side of the difference image on a page: more makes it heavy")


@dataclass(frozen=True)
class SurfaceComparison:
    """What a surface and a reference say of each other; differences are surface minus reference.

    datum: how their heights were brought together. by_slope: of the surface, between pixels; by_kind: the
    reference's classes; by_support: matched, or filled from what lies around. fit: what shift and tilt of the
    reference would fix, after_fit: what is left then. difference_m: (rows, cols) means in cells of cell_m
    from the upper left corner (west_m, north_m), NaN where nothing could be compared.
    """

    reference: str
    datum: str
    over_all: HeightFigures
    by_slope: tuple[tuple[str, HeightFigures], ...]
    by_kind: tuple[tuple[str, HeightFigures], ...]
    by_support: tuple[tuple[str, HeightFigures], ...]
    fit: HeightFit
    after_fit: HeightFigures
    difference_m: Floats32
    cell_m: float
    west_m: float
    north_m: float


def compare_surface(
    surface: Path, confidence: Path, reference: Path, offset_m: float | None, warn: Callable[[str], None]
) -> tuple[SurfaceComparison, Floats32]:
    """Figures, and mean differences on the surface's pixels (rows, cols), NaN where there are none.

    The surface is bilinear between its pixels' middles. Args: see `read_reference`.
    Raises: as `read_reference`; `InputError` for a reference that lies elsewhere.
    """
    with open_raster(surface, OWN) as raster, open_raster(confidence, OWN) as support:
        check_on_earth(raster.crs.to_wkt(version="WKT2_2019"), "comparison with a reference")
        heights = _Heights(raster, surface)
        with reading(confidence, OWN.problem, OWN.fix):
            views = support.read(2)
        points = read_reference(reference, raster, offset_m, warn)
    off = heights.at(points.east_m, points.north_m) - points.height_m
    known = np.isfinite(off)
    if not known.any():
        fix = "give a reference of the same place"
        raise InputError("does not overlap the surface", file=reference, fix=fix)
    off, at = off[known], heights.pixel(points.east_m[known], points.north_m[known])
    slopes, slope_names = slope_classes(heights.slope_deg()[at])
    matched = (views[at] > 0).astype(np.intp)
    fit, after = _after_fit(heights, points, known)
    difference = _means(off, at, views.shape)
    by = max(1, -(-max(views.shape) // _PICTURE_PX))
    comparison = SurfaceComparison(
        reference.name,
        points.datum,
        height_figures(off),
        by_class(off, slopes, slope_names),
        by_class(off, points.kind[known], kind_names(points.kind[known])),
        by_class(off, matched, [(1, "matched"), (0, "filled from what lies around")]),
        fit,
        after,
        _means(off, (at[0] // by, at[1] // by), (-(-views.shape[0] // by), -(-views.shape[1] // by))),
        heights.pixel_m * by,
        heights.west_m,
        heights.north_m,
    )
    return comparison, difference


def _after_fit(heights: _Heights, points: ReferenceHeights, known: Bools) -> tuple[HeightFit, HeightFigures]:
    east, north, height = (v[known] for v in (points.east_m, points.north_m, points.height_m))
    fit = fitted(heights.at, east, north, height, heights.pixel_m)
    east, north, height = fit.moved(east, north, height)
    left = heights.at(east, north) - height
    return fit, height_figures(left[np.isfinite(left)])


class _Heights:
    """A surface's raster in memory, as the surface it was made of."""

    def __init__(self, raster: Raster, path: Path) -> None:
        with reading(path, OWN.problem, OWN.fix):
            self._m = np.where(raster.read_masks(1) > 0, raster.read(1), np.float32(np.nan))
        self.pixel_m, self.west_m, self.north_m = raster.transform.a, raster.transform.c, raster.transform.f

    def at(self, east_m: Floats, north_m: Floats) -> Floats:
        """Heights (n,), NaN next to the surface's edge and holes."""
        row, col = (self.north_m - north_m) / self.pixel_m, (east_m - self.west_m) / self.pixel_m
        place = np.stack([row, col]) - 0.5
        found = map_coordinates(self._m, place, order=1, mode="nearest", output=np.float64)
        rows, cols = self._m.shape
        return np.where((row >= 0.0) & (row <= rows) & (col >= 0.0) & (col <= cols), found, np.nan)

    def pixel(self, east_m: Floats, north_m: Floats) -> tuple[Ints, Ints]:
        """Row and col of the pixels that places on the surface lie in."""
        row = ((self.north_m - north_m) / self.pixel_m).astype(np.intp)
        col = ((east_m - self.west_m) / self.pixel_m).astype(np.intp)
        return row.clip(0, self._m.shape[0] - 1), col.clip(0, self._m.shape[1] - 1)

    def slope_deg(self) -> Floats32:
        """Of each pixel, from its neighbours; 0 where they aren't known."""
        if min(self._m.shape) < 2:
            return np.zeros_like(self._m)
        steepness = np.hypot(*np.gradient(self._m, self.pixel_m))
        return np.asarray(np.degrees(np.arctan(np.nan_to_num(steepness))))


def _means(off_m: Floats, at: tuple[Ints, Ints], shape: tuple[int, int]) -> Floats32:
    """Means by pixel (rows, cols), NaN of none."""
    place = np.ravel_multi_index(at, shape)
    number = np.bincount(place, minlength=shape[0] * shape[1]).reshape(shape)
    sums = np.bincount(place, off_m, shape[0] * shape[1]).reshape(shape)
    return np.where(number > 0, sums / np.maximum(number, 1), np.nan).astype(np.float32)
