"""One surface of all tiles; voids are filled from their neighbours and the base surface."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

import cv2
import numpy as np

from geomosaic.arrays import Floats32
from geomosaic.constants import tuned
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells, Tile
from geomosaic.surface.consistency_filter import RIM_CELLS, FilteredTile
from geomosaic.surface.model import DenseSurface
from geomosaic.surface.tile_sgm import TileHeights, unmatched
from geomosaic.surface.void_fill import SEARCH_CELLS, void_heights

_BAND_ROWS: Final = 256
"""Of cells that are worked on at once; an even number."""
_DECAY = tuned(0.6, "share", "of the height, a doubled distance: 1 runs roofs out to sea; less makes pits")


def with_rim(
    tile: Tile, cells: Cells, base: GroundSurface, near: Iterable[tuple[Tile, TileHeights]]
) -> TileHeights:
    """Heights of a tile's cells and of `RIM_CELLS` on every side, by the tiles near it that hold them; the
    base's, and nothing alike, elsewhere."""
    found = unmatched(base_heights(base, tile.around(cells, RIM_CELLS)))
    row, col = tile.row - RIM_CELLS, tile.col - RIM_CELLS
    for other, heights in near:
        (to_rows, of_rows), (to_cols, of_cols) = (
            _shared(first, size, at, count)
            for first, size, at, count in (
                (row, tile.rows + 2 * RIM_CELLS, other.row, other.rows),
                (col, tile.cols + 2 * RIM_CELLS, other.col, other.cols),
            )
        )
        for name, values in vars(found).items():
            values[to_rows, to_cols] = getattr(heights, name)[of_rows, of_cols]
    return found


def _shared(first: int, size: int, at: int, count: int) -> tuple[slice, slice]:
    """Where the cells that two rows of cells have in common lie in the one and in the other."""
    low, high = max(first, at), max(min(first + size, at + count), max(first, at))
    return slice(low - first, high - first), slice(low - at, high - at)


def base_heights(base: GroundSurface, cells: Cells) -> Floats32:
    """The base's heights (rows, cols) in the cells' middles."""
    east, north = cells.axes_m()
    found = np.empty((cells.rows, cells.cols), dtype=np.float32)
    for band in _bands(cells):
        found[band] = base.up_at(east, north[band, None])
    return found


def mosaic_tiles(
    cells: Cells, base: GroundSurface, parts: Iterable[tuple[Tile, FilteredTile]]
) -> DenseSurface:
    """The surface of all cells. Voids take the lower neighbours' height; far from matched cells they approach
    the base.

    cells: an even number of rows and cols.
    """
    over_m = np.zeros((cells.rows, cells.cols), dtype=np.float32)
    sd_m, views = np.full_like(over_m, np.nan), np.zeros(over_m.shape, dtype=np.uint8)
    for tile, part in parts:
        over_m[tile.at], sd_m[tile.at], views[tile.at] = part.over_m, part.sd_m, part.views
    around_m, around_m2 = _neighbourhood(over_m, sd_m)
    for band in _bands(cells):
        np.copyto(over_m[band], _upsampled(around_m, band), where=np.isnan(sd_m[band]))
    for tile in cells.tiles(_BAND_ROWS):
        _fill_voids(over_m, sd_m, tile)
    east, north = cells.axes_m()
    for band in _bands(cells):
        at = east, north[band, None]
        void = np.isnan(sd_m[band])
        near_m, near_m2 = (_upsampled(a, band) for a in (around_m, around_m2))
        varying = np.maximum(near_m2 - near_m**2, np.float32(0.0)) + (over_m[band] - near_m) ** 2
        over_m[band] += base.up_at(*at)
        void_sd_m = np.sqrt(np.nan_to_num(base.sd_at(*at)) ** 2 + varying)
        sd_m[band] = np.where(void, void_sd_m, sd_m[band])
    return DenseSurface(cells, over_m, sd_m, views)


def _fill_voids(over_m: Floats32, sd_m: Floats32, tile: Tile) -> None:
    """Fills a tile's voids from the lower neighbours."""
    first = max(tile.row - SEARCH_CELLS, 0), max(tile.col - SEARCH_CELLS, 0)
    wide = (
        slice(first[0], tile.row + tile.rows + SEARCH_CELLS),
        slice(first[1], tile.col + tile.cols + SEARCH_CELLS),
    )
    own = Tile(tile.row - first[0], tile.col - first[1], tile.rows, tile.cols).at
    known = np.isfinite(sd_m[wide])
    if not known[own].all():
        lower_m, enclosed = (a[own] for a in void_heights(over_m[wide], known))
        void_m = np.where(enclosed, lower_m, np.minimum(lower_m, over_m[tile.at]))
        np.copyto(over_m[tile.at], void_m, where=~known[own])


def _bands(cells: Cells) -> Iterator[slice]:
    for row in range(0, cells.rows, _BAND_ROWS):
        yield slice(row, min(row + _BAND_ROWS, cells.rows))


def _neighbourhood(over_m: Floats32, sd_m: Floats32) -> tuple[Floats32, Floats32]:
    """What lies around (half the rows, half the cols): heights over the base, and their squares."""
    half = over_m.shape[0] // 2, over_m.shape[1] // 2
    share, mean, square = (np.zeros(half, dtype=np.float32) for _ in range(3))
    for row in range(0, over_m.shape[0], _BAND_ROWS):
        band, to = slice(row, row + _BAND_ROWS), slice(row // 2, (row + _BAND_ROWS) // 2)
        known, values = np.isfinite(sd_m[band]).astype(np.float32), over_m[band]
        size = half[1], known.shape[0] // 2
        for half_of, whole in ((share, known), (mean, values), (square, values**2)):
            half_of[to] = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    weight = np.minimum(share * np.float32(2.0), np.float32(1.0))
    least = np.maximum(share, np.float32(1e-6))
    mean /= least
    square /= least
    return np.float32(_DECAY) * _filled(mean, weight), np.float32(_DECAY) * _filled(square, weight)


def _upsampled(values: Floats32, band: slice) -> Floats32:
    """Values (rows, cols) between twice as many, bilinear: those of a band of rows."""
    first, last = max(band.start // 2 - 1, 0), min(band.stop // 2 + 1, len(values))
    some = values[first:last]
    wide = cv2.resize(some, (2 * some.shape[1], 2 * some.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(wide[band.start - 2 * first : band.stop - 2 * first], dtype=np.float32)


def _filled(values: Floats32, weight: Floats32) -> Floats32:
    """Values (rows, cols) where weight is 1; where it is less, those of coarser and coarser cells around."""
    if min(values.shape) < 2 or weight.min() >= 1.0:
        return values
    size = tuple(-(-n // 2) for n in values.shape[::-1])
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(values * weight, size, interpolation=cv2.INTER_AREA)
    mean = np.where(share > 0.0, mean / np.maximum(share, np.float32(1e-6)), np.float32(0.0))
    coarse = _filled(np.asarray(mean, np.float32), np.asarray(np.minimum(share * 2.0, 1.0), np.float32))
    around = cv2.resize(coarse, values.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(weight * values + (1.0 - weight) * np.float32(_DECAY) * around, dtype=np.float32)
