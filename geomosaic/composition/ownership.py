"""Who gives which part of the mosaic: a frame for every cell, before the first pixel is resampled."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats32, Ints32
from geomosaic.composition.area import Area
from geomosaic.composition.blends import HALO_PX
from geomosaic.composition.frame_cells import AS_FINE, FrameCells, frame_cells
from geomosaic.composition.grid import MOST_CELL_PX, cell_px_by
from geomosaic.composition.hidden import Hidden
from geomosaic.composition.model import OutputGrid, Trimmed
from geomosaic.composition.scene import (
    CELL_PX,
    Scene,
    bounds_window,
    distances_m,
)
from geomosaic.composition.views import FrameView, PosedFrames, frame_views
from geomosaic.composition.window import Window
from geomosaic.constants import tuned

_MOST_CELLS = tuned(16_000_000, "cells", "64 MB of owners: more take memory; fewer coarsen large mosaics")


@dataclass(frozen=True)
class Ownership:
    """The frame that gives each cell of cell_px x cell_px pixels, from the grid's upper left corner on.

    used (n,): which of the survey's frames may give pixels: what an owner doesn't see, another one gives.
    owner (rows, cols): index into `Survey.frames`, plus 1; 0 where no frame sees the ground. area: what the
    mosaic is cut to, if anything; cells far from it have no owner. hidden: what frames can't see of the
    ground for what stands on it. trimmed: what of the frames' land the mosaic leaves out, None where all is
    kept.
    """

    grid: OutputGrid
    used: Bools
    cell_px: int
    owner: Ints32
    area: Area | None = None
    hidden: tuple[Hidden, ...] = ()
    trimmed: Trimmed | None = None

    def shares(self) -> dict[int, float]:
        """The share of the mosaic's land that each frame gives, by its index in `Survey.frames`."""
        owner = self.owner
        if self.area is not None:
            whole = Window(0, 0, self.grid.width_px, self.grid.height_px)
            owner = np.where(self.area.cells(self.grid, whole, self.cell_px), owner, 0)
        cells = np.bincount(owner.ravel())[1:]
        return {int(i): float(cells[i] / cells.sum()) for i in np.flatnonzero(cells)}

    def around(self, window: Window) -> tuple[int, int, Ints32]:
        """The owners of all cells that a window touches, and one more on every side: row and col of the
        first, and the owners. What is outside the grid is as its edge."""
        side, (height, width) = self.cell_px, self.owner.shape
        row, last_row = window.row // side - 1, (window.row + window.height - 1) // side + 2
        col, last_col = window.col // side - 1, (window.col + window.width - 1) // side + 2
        if row >= 0 and col >= 0 and last_row <= height and last_col <= width:
            return row, col, self.owner[row:last_row, col:last_col]
        rows = np.arange(row, last_row).clip(0, height - 1)
        cols = np.arange(col, last_col).clip(0, width - 1)
        return row, col, self.owner[np.ix_(rows, cols)]


def cell_px_of(scene: Scene) -> int:
    """The side of a mosaic's cells: a power of two, as `cell_px_by` or coarser in a large mosaic."""
    grid, side = scene.grid, cell_px_by(scene.views, scene.grid.gsd_m)
    while side < MOST_CELL_PX and grid.width_px * grid.height_px > _MOST_CELLS * side**2:
        side *= 2
    return side


def nearest_nadir(scene: Scene, used: Sequence[bool], cell_px: int) -> tuple[Ownership, Floats32]:
    """Each cell goes to the frame that sees it well and whose nadir point is nearest: it looks down most
    steeply. Frames that see it far more coarsely than the finest come last.

    Frames are looked at where they are the nearest, then once more where the nearest sees nothing.
    Returns: the ownership, and the distance to that point in m, infinite where no frame sees the ground well.
    """
    shape = -(-scene.grid.height_px // cell_px), -(-scene.grid.width_px // cell_px)
    nearest, owner = np.full(shape, np.inf, dtype=np.float32), np.zeros(shape, dtype=np.int32)
    windows = [bounds_window(scene.grid, view, cell_px) for view in scene.views]
    areas = [_cells_in(window, cell_px) for window in windows]
    finest = finest_pixels(scene, cell_px)
    for view, window, at in zip(scene.views, windows, areas, strict=True):
        away_m = distances_m(scene.grid, window, view, cell_px)
        if finest is not None:
            away_m[~frame_cells(scene, view, cell_px, smooth=True).as_fine(finest[at])] = np.inf
        np.copyto(owner[at], view.frame + 1, where=away_m < nearest[at])
        np.minimum(nearest[at], away_m, out=nearest[at])
    unseen = np.zeros(shape, dtype=bool)
    for view, at in zip(scene.views, areas, strict=True):
        mine = owner[at] == view.frame + 1
        if (cells := _cells_of(scene, view, cell_px, mine)) is not None:
            unseen[cells.of_all] |= (owner[cells.of_all] == view.frame + 1) & ~_shows(cells, cell_px)
    nearest[unseen], owner[unseen] = np.inf, 0
    for view, at in zip(scene.views, areas, strict=True):
        if (cells := _cells_of(scene, view, cell_px, unseen[at])) is not None:
            nearer = unseen[cells.of_all] & (cells.distance_m < nearest[cells.of_all])
            nearer &= _shows(cells, cell_px)
            if finest is not None:
                nearer &= cells.as_fine(finest[cells.of_all])
            np.copyto(nearest[cells.of_all], cells.distance_m, where=nearer)
            owner[cells.of_all][nearer] = view.frame + 1
    return Ownership(scene.grid, np.asarray(used, dtype=bool), cell_px, owner), nearest


def finest_pixels(scene: Scene, cell_px: int) -> Floats32 | None:
    """The least `FrameCells.pixel_sizes` of all frames that see a cell well, infinite where none does. None
    where all frames see the ground about as finely."""
    gsd_m = [view.gsd_m for view in scene.views]
    if not gsd_m or max(gsd_m) <= AS_FINE * min(gsd_m):
        return None
    shape = -(-scene.grid.height_px // cell_px), -(-scene.grid.width_px // cell_px)
    finest = np.full(shape, np.inf, dtype=np.float32)
    for view in scene.views:
        cells = frame_cells(scene, view, cell_px, smooth=True)
        of = finest[cells.of_all]
        np.fmin(of, cells.pixel_sizes, out=of, where=_shows(cells, cell_px))
    return finest


def by_nearest_nadir(frames: PosedFrames, grid: OutputGrid) -> Ownership:
    """Of a whole grid, without an area: see `nearest_nadir`."""
    scene = Scene(frames.survey.work_frame, frames.ground, grid, frame_views(frames, grid.crs))
    return nearest_nadir(scene, frames.used, cell_px_of(scene))[0]


def _cells_in(window: Window, cell_px: int) -> tuple[slice, slice]:
    """Rows and cols of a window of whole cells."""
    row, col = window.row // cell_px, window.col // cell_px
    return slice(row, row + window.height // cell_px), slice(col, col + window.width // cell_px)


def _cells_of(scene: Scene, view: FrameView, cell_px: int, wanted: Bools) -> FrameCells | None:
    """The cells about all of a frame's that are wanted, if any are, and those next to them: a single row does
    not show how large pixels are."""
    if not wanted.any():
        return None
    down, across = (np.flatnonzero(wanted.any(axis=axis)) for axis in (1, 0))
    rows, cols = (
        slice(max(int(of[0]) - 1, 0), min(int(of[-1]) + 2, size))
        for of, size in zip((down, across), wanted.shape, strict=True)
    )
    return frame_cells(scene, view, cell_px, smooth=True, part=(rows, cols))


def _shows(cells: FrameCells, cell_px: int) -> Bools:
    """Which cells a frame sees, nothing hides, and it sees well."""
    hidden, well, sees = cells.hidden(cell_px), cells.seen_well, cells.margin_px > 0.0
    if well is not None:
        sees &= well
    return sees if hidden is None else sees & ~hidden


def within(ownership: Ownership, area: Area) -> Ownership:
    """The ownership of a mosaic that is cut to an area: cells in it and about it, as far as blends look."""
    grid, side = ownership.grid, ownership.cell_px
    inside = area.cells(grid, Window(0, 0, grid.width_px, grid.height_px), side)
    reach = 2 * (-(-HALO_PX // side) + 1) + 1
    about = cv2.dilate(inside.view(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    return replace(ownership, owner=np.where(about, ownership.owner, np.int32(0)), area=area)


def owned_cells(ownership: Ownership, window: Window) -> tuple[list[int], Bools]:
    """The frames that own any of a window or of the adjacent cells, and the planning cells in which each may
    own pixels, (k, h, w). Such a planning cell meets the frame's own cells or adjacent ones."""
    row, col, around = ownership.around(window)
    owners = [n for n in np.flatnonzero(np.bincount(around.ravel())).tolist() if n]
    side = ownership.cell_px
    first_row = window.row + np.arange(-(-window.height // CELL_PX)) * CELL_PX
    first_col = window.col + np.arange(-(-window.width // CELL_PX)) * CELL_PX
    met = [((first_row + k) // side - row, (first_col + k) // side - col) for k in range(0, CELL_PX, side)]
    near, kernel = np.zeros((len(owners), *around.shape), dtype=np.uint8), np.ones((3, 3), np.uint8)
    for of, number in zip(near, owners, strict=True):
        cv2.dilate((around == number).view(np.uint8), kernel, of)
    owned = functools.reduce(np.bitwise_or, [near.take(rows, axis=1) for rows, _ in met])
    owned = functools.reduce(np.bitwise_or, [owned.take(cols, axis=2) for _, cols in met])
    return [n - 1 for n in owners], owned.view(bool)


def owner_share(ownership: Ownership, window: Window, rows: slice, cols: slice, frame: int) -> Floats32:
    """How far pixels of part of a window belong to a frame: 1 in the middle of its own cells, 0 in that of
    others', linear between."""
    part = Window(window.col + cols.start, window.row + rows.start, _length(cols), _length(rows))
    row, col, around = ownership.around(part)
    side = ownership.cell_px
    mine = (around == frame + 1).astype(np.float32)
    if (mine == mine[0, 0]).all():
        return np.broadcast_to(mine[0, 0], (part.height, part.width))
    share = cv2.resize(mine, None, fx=side, fy=side, interpolation=cv2.INTER_LINEAR)
    top, left = part.row - row * side, part.col - col * side
    return np.asarray(share[top : top + part.height, left : left + part.width])


def _length(part: slice) -> int:
    return int(part.stop - part.start)
