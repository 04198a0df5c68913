"""Windows of the mosaic as a piece of work by itself: what they take of frames, what of them is written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from geomosaic.arrays import Bools, Ints32
from geomosaic.composition.area import Area
from geomosaic.composition.blends import BLENDS
from geomosaic.composition.frame_part import FramePart
from geomosaic.composition.frame_source import FrameSource
from geomosaic.composition.kept_tile import KeptTile, TilePixels
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.spread import SpooledResult
from geomosaic.composition.tiles import TILE_PX, PackedTile, TileKind
from geomosaic.composition.window import CompositionStep, Manner, SourcePart, Window, compose_window


@dataclass(frozen=True)
class Blending:
    """What all windows of a mosaic share.

    blend: one of BLENDS. sources: the frames that may give pixels, by number. area: what windows are cut to,
    if anything. label_px: side of the cells that seamlines are drawn from. kind, index: of the mosaic's
    tiles, and of those that say who gave each pixel, if they are wanted.
    """

    blend: str
    grid: OutputGrid
    sources: Mapping[int, FrameSource]
    reach_px: float
    area: Area | None
    label_px: int
    kind: TileKind
    index: TileKind | None


@dataclass(frozen=True)
class Wanted:
    """What a window is blended from.

    around: the window with its surroundings. parts: of each source that matters there its number, and the
    rows and cols asked for. gives: all that each source gives to the mosaic. kept: the tile of an earlier
    mosaic that is taken instead.
    """

    window: Window
    around: Window
    parts: tuple[tuple[int, slice, slice], ...]
    gives: tuple[SpooledResult[FramePart], ...]
    kept: TilePixels | None = None

    @classmethod
    def of(
        cls,
        step: CompositionStep,
        gives: Mapping[int, SpooledResult[FramePart]],
        kept: KeptTile | None = None,
    ) -> Wanted:
        """A step of the plan, without the frames themselves, which all windows share."""
        if kept is not None:
            return cls(step.window, step.window, (), (), kept.read(step.window))
        parts = tuple((part.source.number, part.rows, part.cols) for part in step.parts)
        return cls(step.window, step.around, parts, tuple(gives[number] for number, *_ in parts))


@dataclass(frozen=True)
class Blended:
    """A finished window: its tile, and that of who gave each pixel; None where nothing is shown. labels: of
    cells of n x n pixels who gave the middle, from 1; wanted: which of them were asked for, None for all.
    gave: the numbers of the sources that gave pixels."""

    window: Window
    tile: PackedTile | None
    index: PackedTile | None
    labels: Ints32
    wanted: Bools | None
    gave: tuple[int, ...]


@dataclass(frozen=True)
class WantedBlock:
    """What is wanted of the windows under a tile of the first overview, and its place (down, across)."""

    place: tuple[int, int]
    windows: tuple[Wanted, ...]


@dataclass(frozen=True)
class BlendedBlock:
    """The same, finished, and the overview's tiles; None where nothing is shown."""

    place: tuple[int, int]
    windows: tuple[Blended, ...]
    over: PackedTile | None
    index_over: PackedTile | None


def place_over(window: Window) -> tuple[int, int]:
    """Of the first overview's tile over a window."""
    return window.row // (2 * TILE_PX), window.col // (2 * TILE_PX)


def blended(how: Blending, of: WantedBlock) -> BlendedBlock:
    """All pixels of some windows, as tiles of the files they go to."""
    (i, j), made = of.place, []
    tiles: dict[tuple[int, int], PackedTile | None] = {}
    indices: dict[tuple[int, int], PackedTile | None] = {}
    for wanted in of.windows:
        done = _blended(how, wanted)
        at = wanted.window.row // TILE_PX - 2 * i, wanted.window.col // TILE_PX - 2 * j
        tiles[at], indices[at] = done.tile, done.index
        made.append(replace(done, tile=_without_half(done.tile), index=_without_half(done.index)))
    height, width = (
        min(TILE_PX, -(-size // 2) - first * TILE_PX)
        for size, first in ((how.grid.height_px, i), (how.grid.width_px, j))
    )
    index_over = None if how.index is None else how.index.over(indices, height, width)
    return BlendedBlock(of.place, tuple(made), how.kind.over(tiles, height, width), index_over)


def _without_half(tile: PackedTile | None) -> PackedTile | None:
    """A tile whose overview's tile is made."""
    return None if tile is None else replace(tile, half=None, half_valid=None)


def _blended(how: Blending, of: Wanted) -> Blended:
    """All of a window's pixels, as tiles of the files they go to."""
    parts = tuple(SourcePart(how.sources[number], rows, cols) for number, rows, cols in of.parts)
    step = CompositionStep(of.window, of.around, how.reach_px, parts)
    gives: dict[int, Any] = {
        part.source.number: give.look() for part, give in zip(parts, of.gives, strict=True)
    }
    manner = Manner(BLENDS[how.blend], how.kind.bands, how.kind.dtype.name)
    done = of.kept.composed(of.window) if of.kept else compose_window(manner, step, gives)
    if how.area is not None:
        done = done.cut(how.area.mask(how.grid, of.window))
    index = None
    if how.index is not None:
        index = how.index.tile(done.source(how.index.dtype)[..., None], done.valid)
    labels, wanted = done.cells(how.label_px)
    return Blended(of.window, how.kind.tile(done.pixels, done.valid), index, labels, wanted, done.gave)
