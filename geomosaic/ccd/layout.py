"""Where the strips' pixels lie in the scene.

Scene coordinates: a leading-row strip's line u lies nominally at scene line t = u + S / 2. A trailing-row
strip's lies at t = u - S / 2, with S the rows' separation in lines. Scene col = ccd * (width - overlap) +
strip col. Corner origin throughout; raster row r is of scene lines first_line + r to first_line + r + 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.ccd.model import PairOffsets, StripOffsets
from geomosaic.errors import InputError
from geomosaic.survey.strips import StripGeometry

Ends = Literal["all", "common"]
"""Lines of the scene: those that any strip has, or those that all have."""


@dataclass(frozen=True, eq=False)
class StripLookup:
    """Where raster rows see a strip: at knots, bilinear between them across the columns.

    knots_px: (m,) raster cols, ascending, from the first to the last col of the CCD at least.
    image_px: (2, rows, m) the strip's col and line (the file's own) at the middles of the rows. NaN where
    there is no such place, and then nothing between it and the next knots is the strip's.
    """

    knots_px: Floats
    image_px: Floats


class SceneLayout(Protocol):
    """What composition has to know of a scene."""

    @property
    def first_line(self) -> float:
        """Scene line of the raster's upper edge, a whole or half number."""

    @property
    def width_px(self) -> int:
        """Columns of the raster."""

    @property
    def height_px(self) -> int:
        """Rows of the raster."""

    @property
    def seams_px(self) -> tuple[float, ...]:
        """For each pair of CCDs, dead ones too: the raster col at the middle of the overlap."""

    def cols(self, ccd: int) -> tuple[int, int]:
        """The raster cols, first and one beyond the last, that a CCD may fill: to its overlaps' ends."""

    def places(self, ccd: int, top: int, bottom: int) -> StripLookup:
        """Where raster rows top to bottom - 1 see the strip."""


@dataclass(frozen=True, eq=False)
class _Seam:
    """A pair's offsets as a function of the scene's line; (n,) each, one for each line of the left strip.

    line: where it lies in the scene, increasing. right_line: what the right strip has there, never
    decreasing. dcol: by which the right strip lies off its nominal column.
    """

    line: Floats
    left_line: Floats
    right_line: Floats
    dcol_px: Floats

    def side(self, line: Floats, right: bool) -> Floats:
        """Strip col against its nominal place, and strip line, (2, ...), of the left or the right strip."""
        own = self.right_line if right else self.left_line
        beyond = np.minimum(line - self.line[0], 0.0) + np.maximum(line - self.line[-1], 0.0)
        half = np.interp(line, self.line, self.dcol_px) * (0.5 if right else -0.5)
        return np.stack([half, np.interp(line, self.line, own) + beyond])

    def scene_line(self, own_line: float, right: bool) -> float:
        """Where a line of the left or the right strip lies in the scene."""
        own = self.right_line if right else self.left_line
        beyond = min(own_line - own[0], 0.0) + max(own_line - own[-1], 0.0)
        return float(np.interp(own_line, own, self.line) + beyond)


@dataclass(frozen=True, eq=False)
class ImageSpaceLayout:
    """The scene by the pairs' offsets alone: each is split in halves between its two strips.

    Displacements are constant across each overlap, so that both strips of a pair put all of it at the same
    place. Within a strip they go linearly from the left overlap to the right one. At the scene's outer edges
    and next to a dead CCD the other overlap's offset is used throughout. Nothing accumulates from strip to
    strip.
    """

    geometry: StripGeometry
    first_line: float
    height_px: int
    seams: tuple[_Seam | None, ...]

    @property
    def width_px(self) -> int:
        """Columns of the raster: the ideal unbroken line's."""
        return self.geometry.scene_width_px

    @property
    def seams_px(self) -> tuple[float, ...]:
        """For each pair of CCDs, dead ones too: the raster col at the middle of the overlap."""
        g = self.geometry
        return tuple((k + 1) * (g.width_px - g.overlap_px) + 0.5 * g.overlap_px for k in g.pairs)

    def cols(self, ccd: int) -> tuple[int, int]:
        """The raster cols, first and one beyond the last, that a CCD may fill."""
        first = ccd * (self.geometry.width_px - self.geometry.overlap_px)
        return first, first + self.geometry.width_px

    def places(self, ccd: int, top: int, bottom: int) -> StripLookup:
        """Where raster rows top to bottom - 1 see the strip; knots at the ends of its overlaps."""
        first, last = self.cols(ccd)
        overlap = self.geometry.overlap_px
        knots = np.array([first, first + overlap, last - overlap, last], dtype=np.float64)
        middles = np.arange(top, bottom, dtype=np.float64) + (self.first_line + 0.5)
        image = self._edges(ccd, middles)[:, :, [0, 0, 1, 1]]
        image[0] += knots - first
        return StripLookup(knots, image)

    def _nominal(self, ccd: int) -> float:
        return self.geometry.row_separation_lines * (-0.5 if self.geometry.ccds[ccd].row == 1 else 0.5)

    def _edges(self, ccd: int, line: Floats) -> Floats:
        """Strip col against its nominal place, and strip line, (2, n, 2), at the left and right overlap."""
        nominal = np.stack([np.zeros_like(line), line + self._nominal(ccd)])
        found = [
            None if (seam := self._seam(pair)) is None else seam.side(line, right)
            for pair, right in ((ccd - 1, True), (ccd, False))
        ]
        there = [self._there(pair) for pair in (ccd - 1, ccd)]
        left, right = (nominal if f is None else f for f in found)
        if not there[0]:
            left = right
        elif not there[1]:
            right = left
        return np.stack([left, right], axis=-1)

    def _there(self, pair: int) -> bool:
        """Whether there is such a pair, both of its strips living."""
        lines = self.geometry.lines
        return pair in self.geometry.pairs and bool(lines[pair] and lines[pair + 1])

    def _seam(self, pair: int) -> _Seam | None:
        return self.seams[pair] if 0 <= pair < len(self.seams) else None


def image_space_layout(
    geometry: StripGeometry, offsets: StripOffsets, ends: Ends = "all"
) -> ImageSpaceLayout:
    """The layout of strips by their offsets; pairs without any lie at their nominal places.

    Labels are not asked: an unreliable line holds the best guess there is.
    Raises: `InputError` if the strips have no lines in common, where those are wanted.
    """
    seams: list[_Seam | None] = [None] * len(geometry.pairs)
    for pair in offsets.pairs:
        seams[pair.pair] = _seam(geometry, pair)
    layout = ImageSpaceLayout(geometry, 0.0, 0, tuple(seams))
    starts, stops = [], []
    for ccd, lines in enumerate(geometry.lines):
        if lines:
            starts += _scene_lines(layout, ccd, 0.0)
            stops += _scene_lines(layout, ccd, float(lines))
    start, stop = (min(starts), max(stops)) if ends == "all" else (max(starts), min(stops))
    # Where nothing is off, rows of the raster are lines of the strips, moved by half the rows' separation.
    phase = round(geometry.row_separation_lines) / 2.0 % 1.0
    first = math.ceil(start - 0.5 - phase) + phase
    height = math.floor(stop + 0.5 - phase) + phase - first
    if height < 1.0:
        raise InputError(
            ("the strips have no lines in common"),
            fix="use --set mosaic.strips.ends=all, or leave out the shortest strip",
        )
    return ImageSpaceLayout(geometry, first, int(height), tuple(seams))


def _seam(geometry: StripGeometry, pair: PairOffsets) -> _Seam:
    apart = geometry.side(pair.pair) * geometry.row_separation_lines
    left = np.arange(len(pair.dline_px), dtype=np.float64) + 0.5
    right = _never_falling(left + apart + pair.dline_px)
    return _Seam(np.asarray(0.5 * (left + right)), left, right, pair.dcol_px)


def _never_falling(lines: Floats) -> Floats:
    """The lines themselves where they rise; where lost or repeated lines make them fall, a level stretch."""
    return np.asarray(
        0.5 * (np.maximum.accumulate(lines) + np.minimum.accumulate(lines[::-1])[::-1]), dtype=np.float64
    )


def _scene_lines(layout: ImageSpaceLayout, ccd: int, line: float) -> list[float]:
    """Where a line of a strip lies in the scene, at each of its seams."""
    sides = (
        (layout.seams[p], right) for p, right in ((ccd - 1, True), (ccd, False)) if p in layout.geometry.pairs
    )
    found = [seam.scene_line(line, right) for seam, right in sides if seam is not None]
    return found or [line - layout._nominal(ccd)]
