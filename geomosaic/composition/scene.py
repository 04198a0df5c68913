"""The geometry of frames over the output grid: ground under windows, nadirs, margins."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from typing import Any, Final

import cv2
import numpy as np

from geomosaic.arrays import Floats32
from geomosaic.camera.interior import Camera
from geomosaic.composition.blends import STEP_PX
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.views import FrameView
from geomosaic.composition.window import Window
from geomosaic.constants import tuned
from geomosaic.geodesy.local import LocalFrame
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.lattice import MapLattice
from geomosaic.projection.warp import GroundWindow, ground_window

CELL_PX: Final = STEP_PX
"""Of the mosaic: by cells of this side it is planned which frames can matter where."""
_LATTICES = tuned(256, "windows", "kept, 40 kB each: fewer are made again for the next line; more take room")


@dataclass(frozen=True)
class Scene:
    """All geometry of a composition."""

    work_frame: LocalFrame
    ground: GroundSurface
    grid: OutputGrid
    views: tuple[FrameView, ...]

    def __getstate__(self) -> dict[str, Any]:
        """Without what was kept."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @cached_property
    def lattice(self) -> Callable[[Window], MapLattice]:
        """The ground under a window's pixels, kept of the latest: frames side by side see the same."""
        return lru_cache(_LATTICES)(self._lattice)

    def _lattice(self, window: Window) -> MapLattice:
        grid = self.grid.part(window.row, window.col, (window.height, window.width))
        return MapLattice(grid, self.work_frame, self.ground)


def ground_of(scene: Scene, window: Window, step_px: int) -> GroundWindow:
    """Ground points of a window's cells of step_px x step_px."""
    size = -(-window.height // step_px), -(-window.width // step_px)
    return ground_window(
        scene.grid.part(window.row, window.col, size, step_px), scene.work_frame, scene.ground
    )


def bounds_window(grid: OutputGrid, view: FrameView, cell_px: int, beyond_px: int = 0) -> Window:
    """The whole cells of a frame's bounds, one at least, as far as beyond_px outside the grid."""
    west, south, east, north = view.bounds_m
    down_m, right_m = (grid.north_m - north, grid.north_m - south), (west - grid.west_m, east - grid.west_m)
    beyond, spans = -(-beyond_px // cell_px), []
    for (first_m, last_m), size_px in ((down_m, grid.height_px), (right_m, grid.width_px)):
        first = max(math.floor(first_m / (cell_px * grid.gsd_m)) - 1, -beyond)
        last = min(math.floor(last_m / (cell_px * grid.gsd_m)) + 2, -(-size_px // cell_px) + beyond)
        spans.append((first * cell_px, max(last - first, 1) * cell_px))
    (row, height), (col, width) = spans
    return Window(col, row, width, height)


def distances_m(grid: OutputGrid, window: Window, view: FrameView, step_px: int = 1) -> Floats32:
    """From every pixel (or cell) to the frame's nadir point on the map."""
    cols = (np.arange(-(-window.width // step_px)) + 0.5) * step_px + window.col
    rows = (np.arange(-(-window.height // step_px)) + 0.5) * step_px + window.row
    east = (grid.west_m + cols * grid.gsd_m - view.nadir_m[0]).astype(np.float32)
    north = (grid.north_m - rows * grid.gsd_m - view.nadir_m[1]).astype(np.float32)
    return np.asarray(np.sqrt(east**2 + (north**2)[:, None]))


def margin_px(cols: Floats32, rows: Floats32, camera: Camera, mask_distance_px: Floats32 | None) -> Floats32:
    """How far inside its frame's valid pixels a place lies, in px; not above 0 where it is invalid."""
    margin = np.minimum(cols, camera.width_px - cols)
    np.minimum(margin, rows, out=margin)
    np.minimum(margin, camera.height_px - rows, out=margin)
    margin[np.isnan(margin)] = -np.inf
    if mask_distance_px is not None:
        at = [np.where(margin > 0.0, a - np.float32(0.5), np.float32(0.0)) for a in (cols, rows)]
        distance = cv2.remap(
            mask_distance_px, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        np.minimum(margin, distance - 1.0, out=margin)
    return margin
