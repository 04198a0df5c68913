"""What a frame sees, by the cells of a mosaic."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats32
from geomosaic.composition.scene import Scene, bounds_window, distances_m, ground_of, margin_px
from geomosaic.composition.views import FrameView
from geomosaic.composition.window import Window
from geomosaic.constants import tuned
from geomosaic.projection.warp import frame_from_map

AS_FINE = tuned(1.5, "times", "coarser views that may own: less mixes flights at one height; more blurs")
_APART = tuned(4, "cells", "between exact places: farther misses shutter turns by cells; nearer takes time")


@dataclass(frozen=True)
class FrameCells:
    """What a frame sees, by the mosaic's cells from `row` and `col` on, (h, w) each.

    cols_px, rows_px: where the middles of the cells lie in the frame. margin_px: how far inside it, not above
    0 outside. distance_m: how far from its nadir point. relief_m: how high the ground is over a smooth one,
    None where it is smooth.
    """

    view: FrameView
    row: int
    col: int
    cols_px: Floats32
    rows_px: Floats32
    margin_px: Floats32
    distance_m: Floats32
    relief_m: Floats32 | None

    @property
    def of_all(self) -> tuple[slice, slice]:
        """Their place among all cells."""
        height, width = self.margin_px.shape
        return slice(self.row, self.row + height), slice(self.col, self.col + width)

    @property
    def seen_well(self) -> Bools | None:
        """Which of them the frame sees well enough to give them; None where it does all that it sees."""
        return self.view.sees_well(self.cols_px, self.rows_px)

    def as_fine(self, finest: Floats32, at: tuple[slice, slice] = (slice(None), slice(None))) -> Bools:
        """Where the frame sees these of them about as finely as the one that does so best, see
        `finest_pixels`."""
        return np.asarray(self.pixel_sizes[at] <= AS_FINE * finest)

    @property
    def pixel_sizes(self) -> Floats32:
        """The side of a frame's pixel on the ground, over that of a cell; by area, so that oblique views see
        coarsely."""
        if min(self.cols_px.shape) < 2:
            return np.ones_like(self.cols_px)
        (col_down, col_across), (row_down, row_across) = map(np.gradient, (self.cols_px, self.rows_px))
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / np.sqrt(np.abs(col_across * row_down - col_down * row_across)))

    def window(self, cell_px: int) -> Window:
        """The pixels that they cover."""
        height, width = self.margin_px.shape
        return Window(self.col * cell_px, self.row * cell_px, width * cell_px, height * cell_px)

    def hidden(self, cell_px: int) -> Bools | None:
        """Which of them are hidden from the frame, more than half; None where nothing stands before it."""
        if self.view.hidden is None:
            return None
        return np.asarray(self.view.hidden.share(self.window(cell_px), cell_px) > 0.5)


def frame_cells(
    scene: Scene,
    view: FrameView,
    cell_px: int,
    *,
    smooth: bool = False,
    part: tuple[slice, slice] | None = None,
) -> FrameCells:
    """The cells of a frame's bounds; part: some of their rows and cols.

    smooth: places are exact at every fourth cell each way and bilinear between, without the ground's relief.
    """
    window = bounds_window(scene.grid, view, cell_px)
    down, across = part or (slice(0, window.height // cell_px), slice(0, window.width // cell_px))
    relief_m = None
    places = _between(scene, view, window, cell_px, (down, across)) if smooth else None
    if places is None:
        ground = ground_of(scene, window, cell_px)
        places = frame_from_map(ground, view.pose, view.camera, down, across)
        relief_m = None if ground.relief_m is None else ground.relief_m[down, across]
    cols, rows = places
    first = window.row // cell_px + down.start, window.col // cell_px + across.start
    of_part = Window(first[1] * cell_px, first[0] * cell_px, cols.shape[1] * cell_px, cols.shape[0] * cell_px)
    margin, away_m = margin_px(cols, rows, view.camera, None), distances_m(scene.grid, of_part, view, cell_px)
    return FrameCells(view, *first, cols, rows, margin, away_m, relief_m)


def _between(
    scene: Scene, view: FrameView, window: Window, cell_px: int, part: tuple[slice, slice]
) -> tuple[Floats32, Floats32] | None:
    """Cols and rows of part of a window's cells between those of every fourth; None where the lens ends near
    the frame's edge, which would be lost."""
    side, wide = _APART * cell_px, _APART
    down, across = (-(-n // side) + 2 for n in (window.height, window.width))
    around = Window(window.col - side, window.row - side, across * side, down * side)
    places = frame_from_map(ground_of(scene, around, side), view.pose, view.camera)
    beyond_lens = cv2.dilate(np.isnan(places[0]).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    step_px = 1.5 * side * scene.grid.gsd_m / view.gsd_m
    if (margin_px(*places, view.camera, None)[beyond_lens] > -step_px).any():
        return None
    nodes = tuple(slice(of.start // wide, -(-of.stop // wide) + 2) for of in part)
    cells = tuple(
        slice(wide + of.start - of.start // wide * wide, wide + of.stop - of.start // wide * wide)
        for of in part
    )
    cols, rows = (
        cv2.resize(a[nodes], None, fx=wide, fy=wide, interpolation=cv2.INTER_LINEAR)[cells] for a in places
    )
    return np.ascontiguousarray(cols), np.ascontiguousarray(rows)
