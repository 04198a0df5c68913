"""Which of the mosaic's cells each frame sees: all that planning has to know of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomosaic.mosaic.cells import Cells
from geomosaic.mosaic.frames import decode, may_be_masked
from geomosaic.mosaic.ownership import frame_cells
from geomosaic.mosaic.scene import CELL_PX, Scene, margin_px
from geomosaic.mosaic.views import FrameView
from geomosaic.mosaic.window import Window
from geomosaic.survey.model import Frame

Floats32 = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class SeenCells:
    """In which of the mosaic's cells, CELL_PX a side, from row and col on, a frame may show something, and
    which it fills for certain, (h, w) each."""

    row: int
    col: int
    somewhere: Bools
    everywhere: Bools

    @property
    def cells(self) -> Cells:
        """Those in which it may show something."""
        return Cells(self.row, self.col, self.somewhere)

    def put(self, window: Window, to: Bools) -> None:
        """Both into those of a window's cells that they have in common, (2, h, w)."""
        own, at = self.cells.common(window)
        to[0][at], to[1][at] = self.somewhere[own], self.everywhere[own]


@dataclass(frozen=True)
class Sighting:
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


def seen_cells(how: Sighting, one: FrameOnMap) -> SeenCells:
    """What a frame sees; its file is opened only where its format may have invalid pixels.

    Raises: `FileError` if that can't be read.
    """
    mask_px = decode(one.frame, how.kernel_radius_px).mask_distance_px if may_be_masked(one.frame) else None
    return cells_in_view(how.scene, one.view, how.beyond_px, mask_px)


def cells_in_view(
    scene: Scene, view: FrameView, beyond_px: int = 0, mask_distance_px: Floats32 | None = None
) -> SeenCells:
    """What a frame sees by its pose, and its mask if that is given, as far as beyond_px outside the grid."""
    cells = frame_cells(scene, view.widened(), CELL_PX, beyond_px)
    margin = cells.margin_px
    if mask_distance_px is not None:
        margin = margin_px(cells.cols_px, cells.rows_px, view.camera, mask_distance_px)
    slack = _change_within(cells.cols_px, cells.rows_px, CELL_PX * scene.grid.gsd_m / view.gsd_m)
    somewhere, everywhere = margin > -slack, margin > slack
    if view.hidden is not None:
        window = cells.window(CELL_PX)
        somewhere &= view.hidden.widened(-1).share(window, CELL_PX) < 1.0
        everywhere &= view.hidden.widened(1).share(window, CELL_PX) == 0.0
    return SeenCells(cells.row, cells.col, somewhere, everywhere)


def _change_within(cols: Floats32, rows: Floats32, expected_px: float) -> Floats32:
    """Bound on how far the image moves between a cell's middle and its corners, (h, w)."""
    most = np.full(cols.shape, expected_px, dtype=np.float32)
    for axis in (0, 1):
        with np.errstate(over="ignore"):
            step = np.sqrt(np.square(np.diff(cols, axis=axis)) + np.square(np.diff(rows, axis=axis)))
        along, step = np.moveaxis(most, axis, 0), np.moveaxis(step, axis, 0)
        for at in (along[:-1], along[1:]):
            np.fmax(at, step, out=at)
    return most + np.float32(1.0)
