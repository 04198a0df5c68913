"""The warp of whole windows: exact on a lattice of every eighth pixel, bilinear between where that will do.

Perspective, lens and a smooth ground bend an image over hundreds of pixels. The edges of a DEM's cells and
the knots of a table of turns break it along lines. So each cell is checked by its error in the middle; where
that is too large its pixels go through the equations themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats, Floats32, Ints
from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.constants import TOGETHER, sourced, tuned
from geomosaic.geodesy.local import LocalFrame
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.map_grid import MapGrid
from geomosaic.projection.warp import ProjectionEquations, bare_window

STEP_PX = tuned(8, "px", "between exact nodes: 4 computes four times as many; 16 fails MOST_OFF_PX often")
MOST_OFF_PX = tuned(0.005, "frame px", "of a bilinear cell: more shows at breaks; less computes most")
_BEYOND = sourced(0.1, "of its farthest corner's radius", "how far a lens is known past it", "camera.lens")


@dataclass(frozen=True)
class WindowInFrame:
    """Where a frame saw part of a window. cols, rows (h, w): of its pixels, NaN where not seen. node_cols,
    node_rows (h / 8 + 2, w / 8 + 2): the same at the nodes, one beyond on every side."""

    cols: Floats32
    rows: Floats32
    node_cols: Floats32
    node_rows: Floats32

    def between(self, at_nodes: NDArray[Any]) -> NDArray[Any]:
        """Values at the nodes (.., .., bands) as (h, w, bands), bilinear."""
        half, (height, width) = STEP_PX // 2, self.cols.shape
        return _spread(at_nodes)[half : half + height, half : half + width].reshape(height, width, -1)


def may_be_missed(camera: Camera, step_px: float) -> bool:
    """Whether an image may have pixels where places of a grid, step_px of the frame apart, are all NaN."""
    from_middle = camera.corners_px - [camera.principal_col_px, camera.principal_row_px]
    return step_px > _BEYOND * float(np.linalg.norm(from_middle, axis=1).max())


class MapLattice:
    """A north-up map window and its ground: see `ground_window`."""

    def __init__(self, grid: MapGrid, work_frame: LocalFrame, ground: GroundSurface) -> None:
        self._ground, self._gsd_m = ground, grid.gsd_m
        self._window = bare_window(grid, work_frame, ground)
        self._u, self._v = _places(grid.width_px), _places(grid.height_px)
        self._nodes_m = self._relief(self._u.nodes, self._v.nodes[:, None])
        self._corners_m = self._relief(self._u.corners, self._v.corners[:, None])

    def seen(self, pose: Pose, camera: Camera, rows: slice, cols: slice) -> WindowInFrame:
        """Where a frame saw part of the window. rows, cols: in whole steps, but at the window's end."""
        sight = ProjectionEquations(pose, camera)
        height, width = _length(rows, self._window.height_px), _length(cols, self._window.width_px)
        top, left = rows.start // STEP_PX, cols.start // STEP_PX
        down, across = -(-height // STEP_PX), -(-width // STEP_PX)
        nodes = slice(top, top + down + 2), slice(left, left + across + 2)
        corners = slice(top, top + down + 1), slice(left, left + across + 1)
        both = [
            sight.axes(self._window, u[at[1]], v[at[0], None], None if relief_m is None else relief_m[at])
            for at, u, v, relief_m in (
                (nodes, self._u.nodes, self._v.nodes, self._nodes_m),
                (corners, self._u.corners, self._v.corners, self._corners_m),
            )
        ]
        found = np.empty((2, sum(axes[0].size for axes in both)), dtype=np.float32)
        x, y, z = (np.concatenate([axis.ravel() for axis in of]) for of in zip(*both, strict=True))
        sight.image((x, y, z), *found)
        end = both[0][0].size
        image = found[:, :end].reshape(2, down + 2, across + 2)
        middle = found[:, end:].reshape(2, down + 1, across + 1)
        # Cells lie between four nodes, half a step off the part.
        spread = [_spread(axis) for axis in image]
        whole = [_cells_of(axis) for axis in spread]
        cells = np.nonzero(_to_be_exact(image, middle, camera))
        for k in range(0, len(cells[0]), TOGETHER):
            i, j = (c[k : k + TOGETHER] for c in cells)
            exact = self._exact(sight, i + top, j + left, whole[1][i, j])
            for axis, values in zip(whole, exact, strict=True):
                axis[i, j] = values
        half = STEP_PX // 2
        inner = slice(half, half + height), slice(half, half + width)
        return WindowInFrame(spread[0][inner], spread[1][inner], *image)

    def _relief(self, u: Floats, v: Floats) -> Floats32 | None:
        if not self._ground.has_relief:
            return None
        return self._window.relief_on(self._ground, self._gsd_m, u, v)

    def _exact(
        self, sight: ProjectionEquations, i: Ints, j: Ints, row: Floats32
    ) -> tuple[Floats32, Floats32]:
        """All pixels of cells (n, 8, 8), of which row is all but known, or NaN."""
        u, v = self._u.pixels[j][:, None, :], self._v.pixels[i][:, :, None]
        axes = sight.axes(self._window, u, v, self._relief(u, v))
        found, row = np.empty_like(axes[0]), np.ascontiguousarray(row)
        sight.image(axes, found, row, started=not np.isnan(row).any())
        return found, row


def _spread(nodes: NDArray[Any]) -> NDArray[Any]:
    """Values at nodes at all pixels of the cells between them, bilinear."""
    up = cv2.resize(nodes, None, fx=STEP_PX, fy=STEP_PX, interpolation=cv2.INTER_LINEAR)
    half = STEP_PX // 2
    return np.asarray(up[half:-half, half:-half])


@dataclass(frozen=True)
class _Places:
    """u (or v) of the nodes, from one before the window; of the cells' corners; and of the pixels by cells
    between nodes, (cells, 8)."""

    nodes: Floats
    corners: Floats
    pixels: Floats


def _places(length_px: int) -> _Places:
    steps = -(-length_px // STEP_PX)
    per_px, half = 2.0 / length_px, STEP_PX / 2.0
    corners: Floats = np.arange(steps + 1.0) * STEP_PX * per_px - 1.0
    nodes: Floats = (np.arange(-1.0, steps + 1.0) * STEP_PX + half) * per_px - 1.0
    within: Floats = (np.arange(0.5, STEP_PX) - half) * per_px
    return _Places(nodes, corners, corners[:, None] + within)


def _to_be_exact(image: Floats32, middle: Floats32, camera: Camera) -> Bools:
    """Cells that lie in the image, or near it, and whose middle isn't where its four nodes say. Those with
    NaN nodes count as near where the image may lie between nodes."""
    _, down, across = middle.shape
    four = np.stack([image[:, i : i + down, j : j + across] for i in (0, 1) for j in (0, 1)])
    off = np.abs(four.mean(axis=0) - middle).max(axis=0)
    with np.errstate(invalid="ignore"):
        low, high = np.fmin.reduce(four), np.fmax.reduce(four)
        wide = np.nan_to_num(high - low).max(axis=(1, 2), initial=0.0)
        near = np.ones(off.shape, dtype=bool)
        for axis, size in enumerate((camera.width_px, camera.height_px)):
            near &= (high[axis] > -wide[axis]) & (low[axis] < size + wide[axis])
        unknown = np.isnan(off)
        if unknown.all() or (unknown.any() and may_be_missed(camera, float(wide.max()))):
            near |= unknown
        return np.asarray(near & ~(off <= MOST_OFF_PX))


def _cells_of(pixels: Floats32) -> Floats32:
    """(rows, cols) as (cells down, cells across, 8, 8), the same memory."""
    (height, width), (down, across) = pixels.shape, pixels.strides
    shape = height // STEP_PX, width // STEP_PX, STEP_PX, STEP_PX
    return as_strided(pixels, shape, (STEP_PX * down, STEP_PX * across, down, across))


def _length(part: slice, whole: int) -> int:
    return int(min(part.stop, whole) - part.start)
