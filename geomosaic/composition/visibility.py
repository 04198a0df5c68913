"""Which of the mosaic's cells each frame sees: all that planning has to know of a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from geomosaic.arrays import Bools, Floats32, Ints
from geomosaic.composition.cells import MosaicCells
from geomosaic.composition.frames import decode, may_be_masked
from geomosaic.composition.scene import CELL_PX, Scene, bounds_window, ground_of, margin_px
from geomosaic.composition.views import FrameView
from geomosaic.composition.window import Window
from geomosaic.constants import tuned
from geomosaic.projection.lattice import may_be_missed
from geomosaic.projection.warp import GroundWindow, ProjectionEquations, frame_from_map
from geomosaic.survey.model import Frame

_FINER = tuned(2.0, "times", "an oblique frame is finer in front: less loses pixels; more plans for nothing")
_BLOCK = tuned(4, "cells", "tested as one far from an edge: larger leaves more edge; smaller is slow")


@dataclass(frozen=True)
class VisibleCells:
    """In which of the mosaic's cells, CELL_PX a side, from row and col on, a frame may show something, and
    which it fills for certain, (h, w) each."""

    row: int
    col: int
    somewhere: Bools
    everywhere: Bools

    @property
    def cells(self) -> MosaicCells:
        """Those in which it may show something."""
        return MosaicCells(self.row, self.col, self.somewhere)

    def put(self, window: Window, to: Bools) -> None:
        """Both into those of a window's cells that they have in common, (2, h, w)."""
        own, at = self.cells.common(window)
        to[0][at], to[1][at] = self.somewhere[own], self.everywhere[own]


@dataclass(frozen=True)
class VisibilityTest:
    """How frames are looked at: the scene, whose views don't matter, how far beyond its grid, and how far
    resampling reaches into invalid pixels."""

    scene: Scene
    beyond_px: int
    kernel_radius_px: int


@dataclass(frozen=True)
class FrameOnMap:
    """A frame of the survey and where it lies."""

    frame: Frame
    view: FrameView


def visible_cells(how: VisibilityTest, one: FrameOnMap) -> VisibleCells:
    """What a frame sees; its file is opened only where its format may have invalid pixels.

    Raises: `FileError` if that can't be read.
    """
    mask_px = decode(one.frame, how.kernel_radius_px).mask_distance_px if may_be_masked(one.frame) else None
    return cells_in_view(how.scene, one.view, how.beyond_px, mask_px)


def cells_in_view(
    scene: Scene, view: FrameView, beyond_px: int = 0, mask_distance_px: Floats32 | None = None
) -> VisibleCells:
    """What a frame sees by its pose, and its mask if that is given, as far as beyond_px outside the grid."""
    window = bounds_window(scene.grid, view.widened(), CELL_PX, beyond_px)
    if mask_distance_px is None and _smooth(scene):
        somewhere, everywhere = _by_blocks(scene, view, window)
    else:
        cols, rows = frame_from_map(ground_of(scene, window, CELL_PX), view.pose, view.camera)
        margin = margin_px(cols, rows, view.camera, mask_distance_px)
        slack = _change_within(cols, rows, CELL_PX * scene.grid.gsd_m / view.gsd_m, _WITH_DIAGONALS)
        somewhere, everywhere = _within(scene, view, cols, margin, slack)
    if view.hidden is not None:
        somewhere &= view.hidden.widened(-1).share(window, CELL_PX) < 1.0
        everywhere &= view.hidden.widened(1).share(window, CELL_PX) == 0.0
    return VisibleCells(window.row // CELL_PX, window.col // CELL_PX, somewhere, everywhere)


def _smooth(scene: Scene) -> bool:
    """Whether the ground hardly bends within a block of cells, and no object stands on it."""
    ground = scene.ground
    coarse = ground.spacing_m >= _BLOCK * CELL_PX * scene.grid.gsd_m
    return not ground.has_relief or (coarse and not ground.raised)


def _by_blocks(scene: Scene, view: FrameView, window: Window) -> tuple[Bools, Bools]:
    """In which of a window's cells a frame may show something, and which it fills. This is found block by
    block, and cell by cell where a block isn't all one or the other."""
    down, across = window.height // CELL_PX, window.width // CELL_PX
    side, grid = _BLOCK * CELL_PX, scene.grid
    whole = replace(window, height=-(-window.height // side) * side, width=-(-window.width // side) * side)
    ground = ground_of(scene, whole, side)
    cols, rows = frame_from_map(ground, view.pose, view.camera)
    margin = margin_px(cols, rows, view.camera, None)
    slack = _change_within(cols, rows, side * grid.gsd_m / view.gsd_m)
    found = np.repeat(np.repeat([margin > -slack, margin > slack], _BLOCK, axis=1), _BLOCK, axis=2)
    i, j = np.nonzero(np.isnan(cols) | (np.abs(margin) <= slack))
    of_blocks = found.reshape(2, len(margin), _BLOCK, -1, _BLOCK)
    of_blocks[:, i, :, j] = _of_cells(scene, view, ground, i, j)
    return found[0, :down, :across], found[1, :down, :across]


def _of_cells(scene: Scene, view: FrameView, blocks: GroundWindow, i: Ints, j: Ints) -> Bools:
    """The same of all cells of blocks, (n, 2, cells down, cells across), by rows i and cols j of these."""
    cell_m = CELL_PX * scene.grid.gsd_m
    within = (np.arange(_BLOCK) + 0.5)[:, None] / _BLOCK
    u, v = (
        2.0 * (at + within) / length - 1.0 for at, length in ((j, blocks.width_px), (i, blocks.height_px))
    )
    v = v[:, None]
    relief_m = blocks.relief_on(scene.ground, _BLOCK * cell_m, u, v) if scene.ground.has_relief else None
    cols, rows = np.empty((2, _BLOCK, _BLOCK, len(i)), dtype=np.float32)
    sight = ProjectionEquations(view.pose, view.camera)
    sight.image(sight.axes(blocks, u, v, relief_m), cols, rows)
    margin = margin_px(cols, rows, view.camera, None)
    slack = _change_within(cols, rows, cell_m / view.gsd_m).max(axis=(0, 1))
    return np.moveaxis(np.stack(_within(scene, view, cols, margin, slack)), 3, 0)


def _within(
    scene: Scene, view: FrameView, cols: Floats32, margin: Floats32, slack: Floats32
) -> tuple[Bools, Bools]:
    """In which cells a frame may show something, and which it fills. A cell whose middle is NaN may show the
    frame where cells are coarse."""
    somewhere = margin > -slack
    if may_be_missed(view.camera, _FINER * CELL_PX * scene.grid.gsd_m / view.gsd_m):
        somewhere |= np.isnan(cols)
    return somewhere, margin > slack


_TO_NEXT: Final = ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:]))
"""The cells of an array and those next to them."""
_WITH_DIAGONALS: Final = (
    *_TO_NEXT, (np.s_[:-1, :-1], np.s_[1:, 1:]), (np.s_[:-1, 1:], np.s_[1:, :-1])
)  # fmt: skip
"""The same where a corner of an object may lie in a cell."""


def _change_within(
    cols: Floats32, rows: Floats32, expected_px: float, steps: Sequence[tuple[Any, Any]] = _TO_NEXT
) -> Floats32:
    """Bound on how far the image moves between a cell's middle and its corners, (h, w, ..)."""
    most = np.zeros(cols.shape, dtype=np.float32)
    with np.errstate(over="ignore"):
        for before, after in steps:
            step, down = cols[after] - cols[before], rows[after] - rows[before]
            step *= step
            down *= down
            step += down
            for at in (most[before], most[after]):
                np.fmax(at, step, out=at)
    np.sqrt(most, out=most)
    np.maximum(most, np.float32(expected_px), out=most)
    most += np.float32(1.0)
    return most
