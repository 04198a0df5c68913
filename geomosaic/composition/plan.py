"""The plan: which windows, in which order, and which frames can matter in each."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from geomosaic.arrays import Bools, Ints
from geomosaic.composition.cells import MosaicCells, window_cells
from geomosaic.composition.frame_source import FrameSource
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.ownership import Ownership, owned_cells
from geomosaic.composition.scene import CELL_PX, distances_m
from geomosaic.composition.visibility import VisibleCells
from geomosaic.composition.window import CompositionStep, SourcePart, Window
from geomosaic.constants import tuned

_SQUARE_PX = tuned(2048, "mosaic px", "planned together: smaller is call overhead; larger has idle frames")


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

    step: CompositionStep
    asked: Bools


@dataclass(frozen=True)
class Planning:
    """What planning goes by: who owns what, the frames of one scene, what each sees, and how far about a
    window a blend of some reach looks.

    halo_px: in whole cells. What lies farther than a blend looks from the area that the mosaic is cut to is
    not asked for.
    """

    ownership: Ownership
    sources: Mapping[int, FrameSource]
    seen: Mapping[int, VisibleCells]
    halo_px: int
    reach_px: float

    def steps(self, order: Iterable[Window]) -> Iterator[Planned]:
        """What windows take, in their order; those that follow each other within a square are looked up
        together."""
        for _, group in itertools.groupby(order, lambda w: (w.row // _SQUARE_PX, w.col // _SQUARE_PX)):
            some = list(group)
            giving = self._giving(_about(some).grown(self.halo_px))
            for window in some:
                yield self._step(window, giving)

    def _step(self, window: Window, of_square: _Giving) -> Planned:
        """What a window takes from each frame. If a blend there needs more than one frame, the window is
        taken with its surroundings, as far as the blend looks. Each frame then gives its own pixels. It also
        gives those that a blend needs near its own and another frame's."""
        around, cells = window.grown(self.halo_px), self.halo_px // CELL_PX
        giving = of_square.within(around)
        if not giving.numbers:
            return Planned(
                CompositionStep(window, window.grown(0), self.reach_px, ()), np.zeros((0, 0, 0), dtype=bool)
            )
        asked = giving.blended(cells)
        if asked is None:
            rows, cols = _inner(giving.gives, cells)
            around, asked = window.grown(0), giving.gives[:, rows, cols]
        used = _any_of_each(asked)
        asked = asked[used]
        spans = zip(_spans(asked, 2), _spans(asked, 1), strict=True)
        parts = tuple(
            SourcePart(self.sources[number], rows, cols)
            for number, (rows, cols) in zip(itertools.compress(giving.numbers, used), spans, strict=True)
        )
        return Planned(CompositionStep(window, around, self.reach_px, parts), asked)

    def _giving(self, window: Window) -> _Giving:
        """The frames that may give pixels of a window.

        A frame gives what it owns and sees. What an owner doesn't see is given by the nearest frame that
        does. This works with what is certain of each cell, so that it never leaves out a pixel.
        """
        numbers, own = owned_cells(self.ownership, window)
        somewhere, everywhere = self._seen(numbers, window)
        own &= _any_of_each(somewhere)[:, None, None]
        sure = np.logical_or.reduce(own) & ~np.logical_or.reduce(own & ~everywhere)
        gives = somewhere & own
        if not sure.all():
            numbers, somewhere, gives = self._with_nearest(
                window, dict(zip(numbers, gives, strict=True)), sure
            )
        if self.ownership.area is not None:
            side = 2 * (self.halo_px // CELL_PX) + 1
            inside = self.ownership.area.cells(self.ownership.grid, window, CELL_PX)
            gives &= cv2.dilate(inside.view(np.uint8), np.ones((side, side), np.uint8)).view(bool)
        return _Giving(window, numbers, somewhere, gives)

    def _with_nearest(
        self, window: Window, owned: Mapping[int, Bools], sure: Bools
    ) -> tuple[list[int], Bools, Bools]:
        """The same of what is owned, and where no owner fills a cell for sure, of the frames that may be the
        nearest that do."""
        numbers, grid = self._lying.near(window), self.ownership.grid
        somewhere, everywhere = self._seen(numbers, window)
        distance = np.zeros(somewhere.shape, dtype=np.float32)
        for of, number in zip(distance, numbers, strict=True):
            of[:] = distances_m(grid, window, self.sources[number].view, CELL_PX)
        surely = np.where(everywhere, distance, np.inf).min(axis=0, initial=np.inf)
        gives = somewhere & (distance <= surely + np.sqrt(2.0) * CELL_PX * grid.gsd_m) & ~sure
        for of, number in zip(gives, numbers, strict=True):
            of |= owned.get(number, False)
        return numbers, somewhere, gives

    def _seen(self, numbers: Sequence[int], window: Window) -> Bools:
        """In which of a window's cells frames may show something, and which they fill, (2, k, h, w)."""
        found = np.zeros((2, len(numbers), *window_cells(window)), dtype=bool)
        for k, number in enumerate(numbers):
            if number in self.seen:
                self.seen[number].put(window, found[:, k])
        return found

    @cached_property
    def _lying(self) -> BoxIndex:
        return BoxIndex.of(self.seen)


@dataclass(frozen=True)
class _Giving:
    """Frames that may give pixels of a window, in which of its cells each shows something, and in which it
    may give some, (k, h, w) each."""

    window: Window
    numbers: list[int]
    sees: Bools
    gives: Bools

    def within(self, window: Window) -> _Giving:
        """The same of a window in it, of the frames that may give any of it."""
        rows, cols = (slice(a.start // CELL_PX, a.stop // CELL_PX) for a in window.within(self.window))
        sees, gives = self.sees[:, rows, cols], self.gives[:, rows, cols]
        some = _any_of_each(gives)
        return _Giving(window, list(itertools.compress(self.numbers, some)), sees[some], gives[some])

    def blended(self, cells: int) -> Bools | None:
        """What a blend needs of each frame, (k, h, w). The blend looks `cells` cells about what it makes, and
        the window contains these. None where it sees one frame's pixels alone."""
        if len(self.numbers) == 1:
            return None
        inner, side = _inner(self.gives, cells), np.ones((2 * cells + 1, 2 * cells + 1), np.uint8)
        reached = np.array([cv2.dilate(g.view(np.uint8), side) for g in self.gives])
        mixed = np.add.reduce(reached, axis=0, dtype=np.min_scalar_type(len(reached))) > 1
        if not mixed[inner].any():
            return None
        blended = np.zeros_like(mixed)
        blended[inner] = mixed[inner]
        looked_at = cv2.dilate(blended.view(np.uint8), side) > 0
        looked_at[inner] = True
        return np.asarray(looked_at & (self.gives | (self.sees & reached.view(bool) & mixed)))


def _inner(flags: Bools, cells: int) -> tuple[slice, slice]:
    """Of (k, h, w) all but so many on every side."""
    _, down, across = flags.shape
    return slice(cells, down - cells), slice(cells, across - cells)


def _about(some: Sequence[Window]) -> Window:
    """The window about some."""
    row, col = min(w.row for w in some), min(w.col for w in some)
    last_row, last_col = max(w.row + w.height for w in some), max(w.col + w.width for w in some)
    return Window(col, row, last_col - col, last_row - row)


@dataclass(frozen=True)
class BoxIndex:
    """Where frames lie: numbers (n,), and first and last row and col of their cells (n, 4)."""

    numbers: Ints
    boxes: Ints

    @classmethod
    def of(cls, seen: Mapping[int, VisibleCells]) -> BoxIndex:
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


class Asking:
    """What all steps together ask of each frame, by its number."""

    def __init__(self, seen: Mapping[int, VisibleCells]) -> None:
        self._seen = seen
        self._asked: dict[int, MosaicCells] = {}

    def add(self, planned: Planned) -> None:
        """One step more."""
        for part, wanted in zip(planned.step.parts, planned.asked, strict=True):
            cells = self._of(part.source.number)
            own, at = cells.common(planned.step.around)
            cells.flags[own] |= wanted[at]

    def cells(self) -> dict[int, MosaicCells]:
        """Of the frames that are asked for anything, in their order."""
        return dict(sorted(self._asked.items()))

    def _of(self, number: int) -> MosaicCells:
        if number not in self._asked:
            seen = self._seen[number]
            self._asked[number] = MosaicCells(seen.row, seen.col, np.zeros_like(seen.somewhere))
        return self._asked[number]


def _any_of_each(flags: Bools) -> Bools:
    """Whether any is, of each of (k, h, w)."""
    k, h, w = flags.shape
    return np.asarray(flags.reshape(k, h * w).any(axis=1))


def _spans(used: Bools, along: int) -> list[slice]:
    """Of each (k, h, w), where there are any along an axis, from the first to the last, as pixels."""
    any_in = np.asarray(used.any(axis=along))
    first, left = any_in.argmax(axis=1), any_in[:, ::-1].argmax(axis=1)
    ends = zip(first.tolist(), (any_in.shape[1] - left).tolist(), strict=True)
    return [slice(a * CELL_PX, b * CELL_PX) for a, b in ends]
