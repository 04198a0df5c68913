"""The accuracy of a mosaic, cell by cell on a coarser grid: deviations and where heights come from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import shapely
from scipy.ndimage import binary_fill_holes

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Bools, Bytes, Floats, Floats32, Ints
from geomosaic.composition.area import Area, rings_of
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.window import Window
from geomosaic.constants import TOGETHER
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.matching.model import TiePoints
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.warp import ground_window
from geomosaic.quality.ground_accuracy import GroundPropagation, HeightSource
from geomosaic.quality.solved_tables import DOWN_WEIGHTED
from geomosaic.surface.cells import Cells


@dataclass(frozen=True)
class MatchedCells:
    """Which cells (rows, cols) of a dense surface, or of the ground below it, were matched.

    standing_m: root mean square height of what stands on the ground, as far as a surface that shows it was
    matched: what may stand unseen beyond.
    """

    cells: Cells
    matched: Bools
    standing_m: float = 0.0

    def sources(self, east: Floats, north: Floats) -> Bytes:
        """`HeightSource` at places of any shape: matched, filled if matched cells enclose them, extrapolated
        beyond these."""
        col = np.floor((east - self.cells.west_m) / self.cells.cell_m).astype(np.intp)
        row = np.floor((north - self.cells.south_m) / self.cells.cell_m).astype(np.intp)
        within = (col >= 0) & (col < self.cells.cols) & (row >= 0) & (row < self.cells.rows)
        at = row.clip(0, self.cells.rows - 1), col.clip(0, self.cells.cols - 1)
        found = np.where(self.matched[at], HeightSource.MATCHED, HeightSource.FILLED)
        return np.where(within & self._enclosed[at], found, HeightSource.EXTRAPOLATED).astype(np.uint8)

    @cached_property
    def _enclosed(self) -> Bools:
        """Matched cells and voids among them; nothing bounds what stands in a void open to the rim."""
        return np.asarray(binary_fill_holes(self.matched), dtype=bool)


@dataclass(frozen=True)
class AccuracyBlock:
    """Part of the grid from `row` and `col` on, (h, w) each, NaN where the mosaic shows nothing:
    horizontal_m, vertical_m as `GroundDeviations`, source: `HeightSource`."""

    row: int
    col: int
    horizontal_m: Floats32
    vertical_m: Floats32
    source: Floats32


def accuracy_grid(mosaic: OutputGrid, by: int) -> OutputGrid:
    """The grid of cells of by x by of a mosaic's pixels, from its upper left corner on."""
    size = -(-mosaic.width_px // by), -(-mosaic.height_px // by)
    return OutputGrid(mosaic.crs, mosaic.west_m, mosaic.north_m, mosaic.gsd_m * by, *size)


@dataclass(frozen=True)
class AccuracyCells:
    """Accuracy of the mosaic that an ownership describes, in cells of by x by pixels.

    ground: what the mosaic lies on. tied: where tie points fix the ground, see `tied_area`. matched: of a
    ground that was matched.
    """

    ownership: Ownership
    by: int
    work_frame: LocalFrame
    adjusted: Adjusted
    ground: GroundSurface
    tied: Area
    matched: MatchedCells | None = None

    @cached_property
    def grid(self) -> OutputGrid:
        """The cells' own."""
        return accuracy_grid(self.ownership.grid, self.by)

    @cached_property
    def propagation(self) -> GroundPropagation:
        """From poses to the ground, whose slope is taken over a cell."""
        return GroundPropagation(self.adjusted, self.ground, self.grid.gsd_m)

    def blocks(self) -> Iterator[AccuracyBlock]:
        """All of it, row by row."""
        for row in range(0, self.grid.height_px, TOGETHER):
            for col in range(0, self.grid.width_px, TOGETHER):
                size = min(TOGETHER, self.grid.width_px - col), min(TOGETHER, self.grid.height_px - row)
                yield self._block(Window(col, row, *size))

    def _block(self, window: Window) -> AccuracyBlock:
        out = np.full((3, window.height, window.width), np.nan, dtype=np.float32)
        owner = self._owners(window)
        shown = owner > 0
        if shown.any():
            grid = self.grid.part(window.row, window.col, (window.height, window.width))
            points_m = ground_window(grid, self.work_frame, self.ground).points_m()
            source = self._sources(window, points_m)[shown]
            standing_m = 0.0 if self.matched is None else self.matched.standing_m
            standing_sd_m = np.where(source == HeightSource.EXTRAPOLATED, standing_m, 0.0)
            found = self.propagation.at(points_m[shown], owner[shown] - 1, standing_sd_m)
            out[0, shown], out[1, shown] = found.horizontal_m, found.vertical_m
            out[2, shown] = source
        return AccuracyBlock(window.row, window.col, *out)

    def _owners(self, window: Window) -> Ints:
        """The frame plus 1 that gives the middle of each cell, or else any of it; 0 outside the mosaic."""
        owner, side = self.ownership.owner, self.ownership.cell_px
        found = np.zeros((window.height, window.width), dtype=np.intp)
        for down, across in product((self.by // 2, 0, self.by - 1), repeat=2):
            rows = ((window.row + np.arange(window.height)) * self.by + down) // side
            cols = ((window.col + np.arange(window.width)) * self.by + across) // side
            there = owner[np.ix_(rows.clip(0, owner.shape[0] - 1), cols.clip(0, owner.shape[1] - 1))]
            np.copyto(found, there, where=found == 0)
        if self.ownership.area is not None:
            pixels = (n * self.by for n in (window.col, window.row, window.width, window.height))
            found[~self.ownership.area.cells(self.ownership.grid, Window(*pixels), self.by)] = 0
        return found

    def _sources(self, window: Window, points_m: Floats) -> Bytes:
        tied = self.tied.mask(self.grid, window)
        if self.matched is None:
            within = tied | (self.ground.kind == "dem")
            return np.where(within, HeightSource.TIE_SURFACE, HeightSource.EXTRAPOLATED).astype(np.uint8)
        found = self.matched.sources(points_m[..., 0], points_m[..., 1])
        found[~tied & (found == HeightSource.FILLED)] = HeightSource.EXTRAPOLATED
        return found


def standing_m(surface_m: Floats32, terrain_m: Floats32, matched: Bools) -> float:
    """Root mean square height in m of a surface (rows, cols) above the ground below, where it was matched."""
    over_m = (surface_m - terrain_m)[matched]
    return float(np.sqrt(np.square(over_m, dtype=np.float64).mean())) if over_m.size else 0.0


def tied_area(adjusted: Adjusted, ties: TiePoints, work_frame: LocalFrame, crs: str) -> Area:
    """Where tie points fix the ground: of each frame the convex hull of its tie points that count."""
    frame, image_px = _tie_images(adjusted, ties)
    order = np.argsort(frame, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(frame[order])) + 1) if len(frame) else []
    projection, hulls = MapProjection(crs), []
    for mine in parts:
        hull = shapely.convex_hull(shapely.MultiPoint(image_px[mine]))
        if hull.geom_type != "Polygon":
            continue
        i = int(frame[mine[0]])
        edge_px = shapely.get_coordinates(hull)
        edge_m = ground_from_image(adjusted.poses[i], adjusted.cameras[i], adjusted.ground, edge_px)
        edge_m = edge_m[np.isfinite(edge_m).all(axis=1)]
        if len(edge_m) > 2:
            geodetic = work_frame.geodetic_from_enu(edge_m)
            hulls.append(shapely.Polygon(projection.map_from_geodetic(geodetic[:, 0], geodetic[:, 1])))
    return Area(rings_of(shapely.union_all([shapely.make_valid(hull) for hull in hulls])))


def _tie_images(adjusted: Adjusted, ties: TiePoints) -> tuple[Ints, Floats]:
    """Frames (m,) and image coordinates (m, 2) of the tie points that count."""
    residuals = adjusted.image_residuals
    if residuals is not None:
        counts = residuals.weight >= DOWN_WEIGHTED
        return residuals.frame[counts], residuals.image_px[counts]
    sides = [(p.left, p.left_px) for p in ties.pairs] + [(p.right, p.right_px) for p in ties.pairs]
    frame = np.repeat([i for i, _ in sides], [len(px) for _, px in sides]).astype(np.intp)
    return frame, np.concatenate([np.zeros((0, 2)), *(px for _, px in sides)])
