"""The plan: which windows, in which order, and which frames can matter in each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.mosaic.area import Area
from geomosaic.mosaic.frame_source import FrameSource
from geomosaic.mosaic.model import OutputGrid
from geomosaic.mosaic.ownership import owned_cells
from geomosaic.mosaic.scene import CELL_PX, distances_m, ground_of, margin_px
from geomosaic.mosaic.window import Part, Step, Window
from geomosaic.projection.warp import frame_from_map

Floats32 = NDArray[np.float32]
Bools = NDArray[np.bool_]


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


@dataclass(frozen=True)
class Planning:
    """What planning goes by: the frames of one scene, and how far about a window a blend of some reach looks.

    halo_px: in whole cells. area: what the mosaic is cut to, if anything: what lies farther from it than a
    blend looks is not asked for.
    """

    sources: Mapping[int, FrameSource]
    halo_px: int
    reach_px: float
    area: Area | None = None

    def step(
        self, window: Window, masks: Mapping[int, Floats32 | None], among: Sequence[int] | None = None
    ) -> Step:
        """What a window takes: as much around it as a blend looks at if more than one frame gives pixels
        within that, and of each frame its own pixels and those that a blend asks for.

        masks: distances to invalid pixels of the frames whose validity is known (None: all valid). among: the
        frames that come into question.
        """
        frames = list(self.sources.values()) if among is None else [self.sources[i] for i in among]
        around, cells = window.grown(self.halo_px), self.halo_px // CELL_PX
        close = near(frames, around)
        if not close:
            return Step(window, window.grown(0), self.reach_px, ())
        sees, gives = _cells(close, around, masks)
        side = np.ones((2 * cells + 1, 2 * cells + 1), np.uint8)
        if self.area is not None:
            inside = self.area.cells(close[0].scene.grid, around, CELL_PX)
            gives &= cv2.dilate(inside.view(np.uint8), side) > 0
        reached = np.stack([cv2.dilate(g.view(np.uint8), side) > 0 for g in gives])
        mixed = reached.sum(axis=0) > 1
        inner = slice(cells, mixed.shape[0] - cells), slice(cells, mixed.shape[1] - cells)
        if mixed[inner].any():
            asked = gives.copy()
            asked[:, ~_inside(mixed.shape, inner) & ~mixed] = False
            asked |= sees & reached & mixed
        else:
            around, asked = window.grown(0), gives[:, *inner]
        return Step(
            window,
            around,
            self.reach_px,
            tuple(
                Part(source, _span(where.any(axis=1)), _span(where.any(axis=0)))
                for source, where in zip(close, asked, strict=True)
                if where.any()
            ),
        )


def _cells(
    sources: Sequence[FrameSource], window: Window, masks: Mapping[int, Floats32 | None]
) -> tuple[Bools, Bools]:
    """In which cells of a window each frame may show something, and in which it may give it, (k, h, w) each.

    A frame gives what it owns and sees. Of what an owner doesn't see, the nearest frame that does. Works with
    what is certain of each cell, so that it never leaves out a pixel.
    """
    scene = sources[0].scene
    cells = ground_of(scene, window, CELL_PX)
    shape = (len(sources), cells.height_px, cells.width_px)
    distance = np.empty(shape, dtype=np.float32)
    somewhere, everywhere = np.empty(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for k, source in enumerate(sources):
        view = source.view
        cols, rows = frame_from_map(cells, view.pose, view.camera)
        margin = margin_px(cols, rows, view.camera, masks.get(view.frame))
        slack = _change_within_a_cell(cols, rows, CELL_PX * scene.grid.gsd_m / view.gsd_m)
        somewhere[k] = margin > -slack
        if view.frame in masks:
            everywhere[k] = margin > slack
        distance[k] = distances_m(scene.grid, window, view, CELL_PX)
    own = np.stack(owned_cells(sources[0].ownership, window, [s.view for s in sources]))
    sure = own.any(axis=0) & (everywhere | ~own).all(axis=0)
    reach_m = np.sqrt(2.0) * CELL_PX * scene.grid.gsd_m
    surely = np.where(everywhere, distance, np.inf).min(axis=0)
    nearest = somewhere & (distance <= surely + reach_m) & ~sure
    return somewhere, (somewhere & own) | nearest


def near(sources: Sequence[FrameSource], window: Window) -> list[FrameSource]:
    """The frames whose bounds, a little widened, touch a window."""
    if not sources:
        return []
    grid = sources[0].scene.grid
    west, north = grid.west_m + window.col * grid.gsd_m, grid.north_m - window.row * grid.gsd_m
    east, south = west + window.width * grid.gsd_m, north - window.height * grid.gsd_m
    found = []
    for source in sources:
        w, s, e, n = source.view.bounds_m
        wider = 0.02 * max(e - w, n - s) + CELL_PX * grid.gsd_m
        if w - wider < east and e + wider > west and s - wider < north and n + wider > south:
            found.append(source)
    return found


def _change_within_a_cell(cols: Floats32, rows: Floats32, expected_px: float) -> float:
    """Bound on how far the image moves between a cell's middle and its corners."""
    steps = [np.hypot(np.diff(cols, axis=a), np.diff(rows, axis=a)) for a in (0, 1)]
    finite = np.concatenate([s[np.isfinite(s)] for s in steps])
    return max(float(finite.max(initial=0.0)), expected_px) + 1.0


def _inside(shape: tuple[int, ...], inner: tuple[slice, slice]) -> Bools:
    found = np.zeros(shape, dtype=bool)
    found[inner] = True
    return found


def _span(any_in: NDArray[np.bool_]) -> slice:
    """From the first cell in use to the last one, as pixels."""
    used = np.flatnonzero(any_in)
    return slice(int(used[0]) * CELL_PX, (int(used[-1]) + 1) * CELL_PX)
