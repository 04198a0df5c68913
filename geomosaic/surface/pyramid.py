"""From coarse cells to fine ones: what is looked for where, and by which frames."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats, Floats32
from geomosaic.constants import tuned
from geomosaic.projection.ground import GroundSurface, node_spacing_m
from geomosaic.surface.cells import Cells, Tile
from geomosaic.surface.plane_sweep import SweepView
from geomosaic.surface.tile_mosaic import base_heights
from geomosaic.surface.tile_sgm import MARGIN_CELLS, HeightSearch, TileHeights

TILE_CELLS = tuned(304, "cells", "320 with the refined margin: smaller is mostly margin; larger takes memory")
_BELOW = tuned(0.1, "flying heights", "search below the base: less misses ditches and land next to woods")
_ABOVE = tuned(0.3, "flying heights", "search above the base: less cuts off what stands high")
_TALL_M = tuned(15.0, "m", "least search height, whatever the flying height: lower cuts off houses and trees")


MOST_CELLS = tuned(16_000_000, "cells", "17 bytes each in memory; 160 frames of 10 MP have as many at 4 GSD")


@dataclass(frozen=True)
class PyramidLevel:
    """Cells of one size, the heights over the base among which theirs are looked for, and how many of its
    pixels' ground pixel_m is on a side of a picture's. fine: the last level."""

    cells: Cells
    pixel_m: float
    lowest_m: float
    highest_m: float
    fine: bool

    def tasks(
        self, frames: Sequence[SweepView], base: GroundSurface, above: Floats32 | None
    ) -> list[TileTask]:
        """What is to be done, tile by tile: those that two frames see. above: the coarser level's heights."""
        found = []
        tiles = list(self.cells.tiles(TILE_CELLS))
        seen = frames_seeing(frames, base, [tile.around(self.cells, 0) for tile in tiles])
        for tile, places in zip(tiles, seen, strict=True):
            part = _seen_part(tile, places.sum(axis=0) > 1)
            if part is not None:
                cells = part.around(self.cells, MARGIN_CELLS)
                about = None if above is None else self._about(cells, above)
                reach = self.lowest_m, self.highest_m
                search = HeightSearch(cells, self.cells.cell_m, *reach, about, self.fine)
                chosen = np.flatnonzero(places.any(axis=(1, 2)))
                found.append(TileTask(part, search, tuple(chosen.tolist())))
        return found

    def _about(self, cells: Cells, above: Floats32) -> Floats32:
        """The coarser level's heights at some cells of this one, bilinear."""
        coarse = self.cells.coarser(_BY)
        east, north = cells.axes_m()
        col = ((east - coarse.west_m) / coarse.cell_m - 0.5).astype(np.float32)
        row = ((north - coarse.south_m) / coarse.cell_m - 0.5).astype(np.float32)
        found = cv2.remap(above, *np.meshgrid(col, row), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found)

    def assembled(
        self, base: GroundSurface, tasks: Iterable[TileTask], found: Iterable[TileHeights]
    ) -> Floats32:
        """All cells' heights (rows, cols); the base's where no two frames look."""
        up = base_heights(base, self.cells)
        for task, heights in zip(tasks, found, strict=True):
            up[task.tile.at] = heights.up_m
        return up


@dataclass(frozen=True)
class TileTask:
    """A tile as far as two frames see it, what is looked for in it and about it, and the frames (their places
    among all) that are asked."""

    tile: Tile
    search: HeightSearch
    frames: tuple[int, ...]


_PLACES = tuned(9, "places", "visibility tests along a tile's side: fewer miss frames that see a corner")
_BY: Final = 2
"""Fine cells along a coarse one's side."""


def cells_covering(low_m: Floats, high_m: Floats, wanted_m: float) -> Cells:
    """An even number of rows and cols over the rectangle between two corners (2,), of the side that is wanted
    or as much more as keeps to `MOST_CELLS`."""
    cell_m = node_spacing_m(low_m, high_m, wanted_m, MOST_CELLS)
    cols, rows = (_BY * int(n) for n in np.ceil((high_m - low_m) / (_BY * cell_m)))
    return Cells(float(low_m[0]), float(low_m[1]), cell_m, max(rows, _BY), max(cols, _BY))


def pyramid_levels(cells: Cells, flying_m: float) -> list[PyramidLevel]:
    """The coarse level and the fine one, whose cells are given; a cell is two of their pictures' pixels wide,
    which halves errors against one."""
    lowest_m = -_BELOW * flying_m
    highest_m = min(max(_TALL_M, _ABOVE * flying_m), 2.0 * _ABOVE * flying_m)
    coarse = cells.coarser(_BY)
    return [
        PyramidLevel(coarse, coarse.cell_m / 2.0, lowest_m, highest_m, fine=False),
        PyramidLevel(cells, cells.cell_m / 2.0, lowest_m, highest_m, fine=True),
    ]


def frames_seeing(frames: Sequence[SweepView], base: GroundSurface, tiles: Sequence[Cells]) -> Bools:
    """Which frames see which of a grid of places of each tile: (tiles, frames, north, east)."""
    share = np.linspace(0.0, 1.0, _PLACES)
    west, south, east, north = (
        np.array(ends)[:, None]
        for ends in zip(*((a[0], b[0], a[-1], b[-1]) for a, b in (t.axes_m() for t in tiles)), strict=True)
    )
    at = np.broadcast_arrays(
        (west + share * (east - west))[:, None, :], (south + share * (north - south))[:, :, None]
    )
    places = np.stack([*at, base.up_at(*at)], axis=-1)
    seen = []
    for frame in frames:
        col, row = np.moveaxis(frame.pose.image_from_ground(frame.camera, places), -1, 0)
        size = frame.camera.width_px, frame.camera.height_px
        seen.append((col >= 0.0) & (col < size[0]) & (row >= 0.0) & (row < size[1]))
    return np.stack(seen, axis=1)


def _seen_part(tile: Tile, seen: Bools) -> Tile | None:
    """The part of a tile about those of its places (north, east) that are seen, as far as the next ones."""
    if not seen.any():
        return None
    ends = []
    for axis, size in ((1, tile.rows), (0, tile.cols)):
        at = np.flatnonzero(seen.any(axis=axis))
        first, last = (np.array([at[0] - 1, at[-1] + 1]).clip(0, _PLACES - 1) * (size - 1)) // (_PLACES - 1)
        ends.append((int(first), int(last - first) + 1))
    (row, rows), (col, cols) = ends
    return Tile(tile.row + row, tile.col + col, rows, cols)
