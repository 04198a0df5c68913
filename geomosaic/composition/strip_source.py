"""A CCD strip as a source of the scene: its share by the seams, its pixels by the scene's layout."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from typing import Any

import numpy as np

from geomosaic.arrays import Floats32
from geomosaic.ccd.layout import SceneLayout
from geomosaic.composition.strip_lines import StripLines
from geomosaic.composition.strip_window import StripBlock, part_of_strip
from geomosaic.composition.window import CompositionStep, SourcePixels, Window


@dataclass(frozen=True, eq=False)
class StripSource:
    """A living CCD, by its place among them. Its material is `StripBlock`.

    left_px, right_px: raster cols of its seams, infinite where there is none.
    """

    number: int
    ccd: int
    layout: SceneLayout
    strip: StripLines
    resampling: str
    left_px: float
    right_px: float

    def share(self, window: Window, rows: slice, cols: slice) -> Floats32:
        """How far between its seams columns lie: both sides of one are even there."""
        middle = window.col + np.arange(cols.start, cols.stop) + 0.5
        return np.minimum(middle - self.left_px, self.right_px - middle).astype(np.float32)[None]

    def shown(self, window: Window, rows: slice, cols: slice, material: StripBlock) -> SourcePixels:
        """Resampled; beyond the scene's first and last rows there is nothing."""
        shape = rows.stop - rows.start, cols.stop - cols.start
        first, last = window.row + rows.start, window.row + rows.stop
        top, bottom = max(first, 0), min(last, self.layout.height_px)
        reach = window.col + cols.start, window.col + cols.stop
        found = part_of_strip(material, self.strip.count, (top, bottom), reach, self.resampling)
        pixels, margin = found.pixels[..., None], None
        if not found.valid.all() or (top, bottom) != (first, last):
            margin = np.full(shape, -np.inf, dtype=np.float32)
            margin[top - first : bottom - first][found.valid] = np.inf
        if (top, bottom) != (first, last):
            pixels = np.zeros((*shape, 1), dtype=np.float32)
            pixels[top - first : bottom - first] = found.pixels[..., None]
        return SourcePixels(pixels, margin)

    def block(self, top: int, bottom: int, before: Future[StripBlock] | None) -> StripBlock:
        """What rows top to bottom - 1 of the scene need, once what lies before them is through."""
        if before is not None:
            before.result()
        top, bottom = max(top, 0), min(bottom, self.layout.height_px)
        places = self.layout.places(self.ccd, top, bottom)
        line = places.image_px[1]
        line = line[(line >= 0.0) & (line <= self.strip.count)]
        lines = self.strip.between(float(line.min()), float(line.max())) if line.size else None
        return StripBlock(top, places, lines)


class StripBlocks:
    """The strips' blocks, read in order: one job for each strip and block of rows.

    `rows[n]` are the scene's rows, first and one beyond the last, that step n's block needs.
    """

    def __init__(
        self,
        sources: Sequence[StripSource],
        steps: Sequence[CompositionStep],
        rows: Sequence[tuple[int, int]],
        pool: Executor,
    ) -> None:
        self._sources, self._steps, self._rows, self._pool = sources, steps, rows, pool
        self._latest: dict[int, tuple[tuple[int, int], Future[StripBlock]]] = {}

    def for_step(self, step: int) -> dict[int, Future[StripBlock]]:
        """The blocks of the step's strips."""
        return {part.source.number: self._block(part.source.number, step) for part in self._steps[step].parts}

    def _block(self, number: int, step: int) -> Future[Any]:
        rows = self._rows[step]
        before = self._latest.get(number)
        if before is None or before[0] != rows:
            job = self._pool.submit(self._sources[number].block, *rows, before[1] if before else None)
            self._latest[number] = before = rows, job
        return before[1]
