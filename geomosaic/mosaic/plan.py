"""The plan: which windows, in which order, and which frames can matter in each."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.mosaic.area import Area
from geomosaic.mosaic.cells import Cells
from geomosaic.mosaic.frame_source import FrameSource
from geomosaic.mosaic.model import OutputGrid
from geomosaic.mosaic.ownership import owned_cells
from geomosaic.mosaic.scene import CELL_PX, distances_m
from geomosaic.mosaic.sight import SeenCells
from geomosaic.mosaic.window import Part, Step, Window

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
class Planned:
    """A step, and the cells of its surroundings that each of its parts is asked for, (parts, h, w)."""

    step: Step
    asked: Bools


@dataclass(frozen=True)
class Planning:
    """What planning goes by: the frames of one scene, what each sees, and how far about a window a blend of
    some reach looks.

    halo_px: in whole cells. area: what the mosaic is cut to, if anything: what lies farther from it than a
    blend looks is not asked for.
    """

    sources: Mapping[int, FrameSource]
    seen: Mapping[int, SeenCells]
    halo_px: int
    reach_px: float
    area: Area | None = None

    def step(self, window: Window) -> Planned:
        """What a window takes: as much around it as a blend looks at if more than one frame gives pixels
        within that, and of each frame its own pixels and those that a blend asks for: where others give some
        as near, and its own as well."""
        around, cells = window.grown(self.halo_px), self.halo_px // CELL_PX
        close, sees, sure = self._near(around)
        if not close:
            return Planned(Step(window, window.grown(0), self.reach_px, ()), np.zeros((0, 0, 0), dtype=bool))
        gives = _given(close, sees, sure, around)
        side = np.ones((2 * cells + 1, 2 * cells + 1), np.uint8)
        if self.area is not None:
            inside = self.area.cells(close[0].grid, around, CELL_PX)
            gives &= cv2.dilate(inside.view(np.uint8), side) > 0
        reached = np.stack([cv2.dilate(g.view(np.uint8), side) > 0 for g in gives])
        mixed = reached.sum(axis=0) > 1
        inner = np.s_[cells : mixed.shape[0] - cells, cells : mixed.shape[1] - cells]
        if mixed[inner].any():
            blended = np.zeros_like(mixed)
            blended[inner] = mixed[inner]
            looked_at = cv2.dilate(blended.view(np.uint8), side) > 0
            looked_at[inner] = True
            asked = looked_at & (gives | (sees & reached & mixed))
        else:
            around, asked = window.grown(0), gives[:, *inner]
        used = asked.any(axis=(1, 2))
        asked = asked[used]
        parts = tuple(
            Part(source, _span(where.any(axis=1)), _span(where.any(axis=0)))
            for source, where in zip(itertools.compress(close, used), asked, strict=True)
        )
        return Planned(Step(window, around, self.reach_px, parts), asked)

    def _near(self, window: Window) -> tuple[list[FrameSource], Bools, Bools]:
        """The frames that may show something of a window, and in which of its cells: somewhere in them, and
        all over them, (k, h, w)."""
        found = [(number, *self.seen[number].within(window)) for number in self._lying.near(window)]
        found = [one for one in found if one[1].any()]
        sources = [self.sources[number] for number, *_ in found]
        return sources, np.array([s for _, s, _ in found]), np.array([e for *_, e in found])

    @cached_property
    def _lying(self) -> BoxIndex:
        return BoxIndex.of(self.seen)


@dataclass(frozen=True)
class BoxIndex:
    """Where frames lie: numbers (n,), and first and last row and col of their cells (n, 4)."""

    numbers: NDArray[np.intp]
    boxes: NDArray[np.intp]

    @classmethod
    def of(cls, seen: Mapping[int, SeenCells]) -> BoxIndex:
        """In the order of the mapping."""
        boxes = [(s.row, s.col, *np.add((s.row, s.col), s.somewhere.shape)) for s in seen.values()]
        return cls(np.array(list(seen), dtype=np.intp), np.array(boxes, dtype=np.intp).reshape(-1, 4))

    def near(self, window: Window) -> list[int]:
        """The frames whose cells reach into a window."""
        row, col = window.row // CELL_PX, window.col // CELL_PX
        last_row, last_col = row - (-window.height // CELL_PX), col - (-window.width // CELL_PX)
        first, left, last, right = self.boxes.T
        close = (first < last_row) & (last > row) & (left < last_col) & (right > col)
        return [int(n) for n in self.numbers[close]]


def _given(sources: Sequence[FrameSource], somewhere: Bools, everywhere: Bools, window: Window) -> Bools:
    """In which cells of a window each frame may give pixels, (k, h, w).

    A frame gives what it owns and sees. Of what an owner doesn't see, the nearest frame that does. Works with
    what is certain of each cell, so that it never leaves out a pixel.
    """
    grid = sources[0].grid
    own = owned_cells(sources[0].ownership, window, [s.view for s in sources])
    sure = own.any(axis=0) & (everywhere | ~own).all(axis=0)
    if sure.all():
        return np.asarray(somewhere & own)
    distance = np.stack([distances_m(grid, window, s.view, CELL_PX) for s in sources])
    reach_m = np.sqrt(2.0) * CELL_PX * grid.gsd_m
    surely = np.where(everywhere, distance, np.inf).min(axis=0)
    nearest = somewhere & (distance <= surely + reach_m) & ~sure
    return np.asarray((somewhere & own) | nearest)


class Asking:
    """What all steps together ask of each frame, by its number."""

    def __init__(self, seen: Mapping[int, SeenCells]) -> None:
        self._seen = seen
        self._asked: dict[int, Cells] = {}

    def add(self, planned: Planned) -> None:
        """One step more."""
        for part, cells in zip(planned.step.parts, planned.asked, strict=True):
            own, at = self._of(part.source.number).common(planned.step.around)
            self._of(part.source.number).flags[own] |= cells[at]

    def cells(self) -> dict[int, Cells]:
        """Of the frames that are asked for anything, in their order."""
        return dict(sorted(self._asked.items()))

    def _of(self, number: int) -> Cells:
        seen = self._seen[number]
        return self._asked.setdefault(number, Cells(seen.row, seen.col, np.zeros_like(seen.somewhere)))


def _span(any_in: NDArray[np.bool_]) -> slice:
    """From the first cell in use to the last one, as pixels."""
    used = np.flatnonzero(any_in)
    return slice(int(used[0]) * CELL_PX, (int(used[-1]) + 1) * CELL_PX)
