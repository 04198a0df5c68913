"""The plan: which windows, in which order, and which frames can matter in each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.camera.interior import Camera
from geomosaic.geodesy.local import LocalFrame
from geomosaic.mosaic.model import OutputGrid
from geomosaic.mosaic.views import FrameView
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.warp import GroundWindow, frame_from_map, ground_window

Floats32 = NDArray[np.float32]
CELL_PX = 16


@dataclass(frozen=True)
class Window:
    """A part of the output grid: its first col and row, width and height."""

    col: int
    row: int
    width: int
    height: int

    def grown(self, px: int) -> Window:
        """With so many pixels more on every side, past the grid's edge as well."""
        return Window(self.col - px, self.row - px, self.width + 2 * px, self.height + 2 * px)


@dataclass(frozen=True)
class Part:
    """The part of a window in which a frame can matter, as slices of the window."""

    view: FrameView
    rows: slice
    cols: slice


@dataclass(frozen=True)
class Scene:
    """All geometry of a composition."""

    work_frame: LocalFrame
    ground: GroundSurface
    grid: OutputGrid
    views: tuple[FrameView, ...]


def windows(grid: OutputGrid, side_px: int) -> list[Window]:
    """The grid's windows along Hilbert's curve, on which neighbours in time are neighbours in space."""
    across, down = -(-grid.width_px // side_px), -(-grid.height_px // side_px)
    order = max(across, down, 1).bit_length()
    places = sorted(
        ((j, i) for j in range(down) for i in range(across)), key=lambda p: _hilbert(order, p[1], p[0])
    )
    return [
        Window(
            i * side_px,
            j * side_px,
            min(side_px, grid.width_px - i * side_px),
            min(side_px, grid.height_px - j * side_px),
        )
        for j, i in places
    ]


def _hilbert(order: int, x: int, y: int) -> int:
    """Distance along Hilbert's curve through 2^order x 2^order cells (Hilbert 1891)."""
    distance = 0
    for s in (1 << k for k in reversed(range(order))):
        right, upper = bool(x & s), bool(y & s)
        distance += s * s * ((3 * right) ^ upper)
        if not upper:
            if right:
                x, y = ~x, ~y
            x, y = y, x
    return distance


def ground_of(scene: Scene, window: Window, step_px: int = 1) -> GroundWindow:
    """Ground points of a window's pixels, or of its cells of step_px x step_px."""
    grid = scene.grid
    return ground_window(
        grid.crs,
        scene.work_frame,
        scene.ground,
        grid.west_m + window.col * grid.gsd_m,
        grid.north_m - window.row * grid.gsd_m,
        grid.gsd_m * step_px,
        -(-window.width // step_px),
        -(-window.height // step_px),
    )


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


def parts(
    scene: Scene,
    window: Window,
    views: Sequence[FrameView],
    mask_distances_px: Mapping[int, Floats32 | None],
    owned: Sequence[NDArray[np.bool_]],
) -> tuple[Part, ...]:
    """Which of the frames can give pixels in a window, and where; in the views' order.

    A frame gives what it owns and sees. Of what an owner doesn't see, the nearest frame that does. Works on
    cells of 16 px with what is certain of each, so that it never leaves out a pixel.

    Args: mask_distances_px: of the frames whose validity is known (None: all valid). owned: of each view, the
    cells in which it may own pixels.
    """
    if not views:
        return ()
    cells = ground_of(scene, window, CELL_PX)
    shape = (len(views), cells.height_px, cells.width_px)
    distance = np.empty(shape, dtype=np.float32)
    somewhere, everywhere = np.empty(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for k, view in enumerate(views):
        cols, rows = frame_from_map(cells, view.pose, view.camera)
        margin = margin_px(cols, rows, view.camera, mask_distances_px.get(view.frame))
        slack = _change_within_a_cell(cols, rows, CELL_PX * scene.grid.gsd_m / view.gsd_m)
        somewhere[k] = margin > -slack
        if view.frame in mask_distances_px:
            everywhere[k] = margin > slack
        distance[k] = distances_m(scene.grid, window, view, CELL_PX)
    own = np.stack(owned)
    sure = own.any(axis=0) & (everywhere | ~own).all(axis=0)
    reach_m = np.sqrt(2.0) * CELL_PX * scene.grid.gsd_m
    surely = np.where(everywhere, distance, np.inf).min(axis=0)
    nearest = somewhere & (distance <= surely + reach_m) & ~sure
    found = []
    for view, where in zip(views, (somewhere & own) | nearest, strict=True):
        if where.any():
            found.append(Part(view, _span(where.any(axis=1)), _span(where.any(axis=0))))
    return tuple(found)


def near(scene: Scene, window: Window) -> list[FrameView]:
    """The frames whose bounds, a little widened, touch a window."""
    grid = scene.grid
    west, north = grid.west_m + window.col * grid.gsd_m, grid.north_m - window.row * grid.gsd_m
    east, south = west + window.width * grid.gsd_m, north - window.height * grid.gsd_m
    found = []
    for view in scene.views:
        w, s, e, n = view.bounds_m
        wider = 0.02 * max(e - w, n - s) + CELL_PX * grid.gsd_m
        if w - wider < east and e + wider > west and s - wider < north and n + wider > south:
            found.append(view)
    return found


def _change_within_a_cell(cols: Floats32, rows: Floats32, expected_px: float) -> float:
    """Bound on how far the image moves between a cell's middle and its corners."""
    steps = [np.hypot(np.diff(cols, axis=a), np.diff(rows, axis=a)) for a in (0, 1)]
    finite = np.concatenate([s[np.isfinite(s)] for s in steps])
    return max(float(finite.max(initial=0.0)), expected_px) + 1.0


def _span(any_in: NDArray[np.bool_]) -> slice:
    """Cells in use, as pixels of the window (may run past its end, as slices may)."""
    used = np.flatnonzero(any_in)
    return slice(int(used[0]) * CELL_PX, (int(used[-1]) + 1) * CELL_PX)
