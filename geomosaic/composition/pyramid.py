"""A raster's tiles as they come: gathered from windows, halved into overviews, packed when they are whole.

A tile is packed once, by the thread that brings its last pixel, and then only lies in a file until the raster
is put together. Memory has only tiles that are not whole yet.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats, Ints64
from geomosaic.composition.tiles import TILE_PX, PackedTile, TileKind
from geomosaic.composition.window import Window


@dataclass
class _Gathered:
    """A tile in the making: pixels and valid ones, once there are any; how many pixels came."""

    pixels: NDArray[Any] | None = None
    valid: Bools | None = None
    count: int = 0


@dataclass(frozen=True)
class RasterLevel:
    """A raster or an overview of it.

    width, height: its size. places (down, across, 3): where each tile lies in the file of tiles. It is its
    first byte, the bytes of its pixels and those of its mask. A tile without a valid pixel has 0 bytes.
    """

    width: int
    height: int
    places: Ints64


class RasterPyramid:
    """A raster and its overviews, tile by tile. Windows may come in any order and by any thread, each pixel
    once; what never comes is empty. The tiles don't depend on how they came, but where they lie does.

    tiles: an open file of its own, to write and read.
    """

    def __init__(self, width: int, height: int, kind: TileKind, tiles: IO[bytes], *, overviews: bool) -> None:
        self.kind, self.tiles = kind, tiles
        self.levels: list[RasterLevel] = []
        while True:
            shape = -(-height // TILE_PX), -(-width // TILE_PX)
            self.levels.append(RasterLevel(width, height, np.zeros((*shape, 3), np.int64)))
            if not overviews or shape == (1, 1):
                break
            width, height = -(-width // 2), -(-height // 2)
        self._lock, self._end = threading.Lock(), 0
        self._gathered: list[dict[tuple[int, int], _Gathered]] = [{} for _ in self.levels]
        self._figures: dict[tuple[int, int], Floats] = {}

    def add(self, window: Window, pixels: NDArray[Any], valid: Bools) -> None:
        """A window's pixels (h, w, bands), 0 where not valid (h, w)."""
        some = bool(valid.any())
        self._add(0, window, pixels if some else None, valid if some else None)

    def add_nothing(self, window: Window) -> None:
        """A window without a valid pixel."""
        self._add(0, window, None, None)

    def finish(self) -> None:
        """No more will come."""
        for level, gathered in enumerate(self._gathered):
            for at in sorted(gathered):
                tile = gathered.pop(at)
                self._whole(level, at, tile.pixels, tile.valid)

    def statistics(self) -> Floats | None:
        """Least, most, mean and standard deviation of all valid pixels by band, (4, bands); None of none."""
        if not self._figures:
            return None
        count, least, most, means, squares = np.array(
            [of for _, of in sorted(self._figures.items(), key=lambda f: f[0])]
        ).swapaxes(0, 1)
        mean, square = (np.average(of, axis=0, weights=count) for of in (means, squares))
        return np.array(
            [least.min(axis=0), most.max(axis=0), mean, np.sqrt(np.maximum(square - mean**2, 0.0))]
        )

    def _add(self, level: int, window: Window, pixels: Any, valid: Bools | None) -> None:
        col, row, width, height = window.col, window.row, window.width, window.height
        for i in range(row // TILE_PX, -(-(row + height) // TILE_PX)):
            for j in range(col // TILE_PX, -(-(col + width) // TILE_PX)):
                rows, cols = _common(row, height, i), _common(col, width, j)
                part = tuple(slice(s.start - a, s.stop - a) for s, a in ((rows, row), (cols, col)))
                at = tuple(
                    slice(s.start - n * TILE_PX, s.stop - n * TILE_PX) for s, n in ((rows, i), (cols, j))
                )
                self._part(
                    level,
                    (i, j),
                    at,
                    None if pixels is None else pixels[part],
                    None if valid is None else valid[part],
                )

    def _part(
        self, level: int, tile: tuple[int, int], at: tuple[slice, ...], pixels: Any, valid: Bools | None
    ) -> None:
        """What came of a tile. Its last part, or the whole of it, lets it be packed."""
        of = self.levels[level]
        height, width = (
            min(TILE_PX, of.height - tile[0] * TILE_PX),
            min(TILE_PX, of.width - tile[1] * TILE_PX),
        )
        count = (at[0].stop - at[0].start) * (at[1].stop - at[1].start)
        if count < height * width:
            with self._lock:
                found = self._gathered[level].setdefault(tile, _Gathered())
                found.count += count
                if pixels is not None and valid is not None:
                    if found.pixels is None or found.valid is None:
                        found.pixels = np.zeros((height, width, self.kind.bands), self.kind.dtype)
                        found.valid = np.zeros((height, width), bool)
                    found.pixels[at], found.valid[at] = pixels, valid
                if found.count < height * width:
                    return
                del self._gathered[level][tile]
            pixels, valid = found.pixels, found.valid
        self._whole(level, tile, pixels, valid)

    def _whole(self, level: int, tile: tuple[int, int], pixels: Any, valid: Bools | None) -> None:
        self.put(level, tile, None if valid is None else self.kind.tile(pixels, valid, first=level == 0))

    def put(self, level: int, tile: tuple[int, int], made: PackedTile | None) -> None:
        """A whole tile (down, across), and its part of the next overview."""
        self._lay(level, tile, made)
        if level + 1 < len(self.levels):
            of, (i, j), half = self.levels[level], tile, TILE_PX // 2
            height, width = min(TILE_PX, of.height - i * TILE_PX), min(TILE_PX, of.width - j * TILE_PX)
            window = Window(j * half, i * half, -(-width // 2), -(-height // 2))
            pixels, valid = (None, None) if made is None else (made.half, made.half_valid)
            self._add(level + 1, window, pixels, valid)

    def put_under(
        self,
        tile: tuple[int, int],
        made: Mapping[tuple[int, int], PackedTile | None],
        over: PackedTile | None,
    ) -> None:
        """All tiles of the raster under one of the first overview, made elsewhere with that one."""
        for at, one in made.items():
            self._lay(0, at, one)
        if len(self.levels) > 1:
            self.put(1, tile, over)

    def _lay(self, level: int, tile: tuple[int, int], made: PackedTile | None) -> None:
        """Brings a tile's bytes to the file."""
        if made is None:
            return
        with self._lock:
            self.levels[level].places[tile] = self._end, len(made.packed), len(made.mask)
            self.tiles.write(made.packed)
            self.tiles.write(made.mask)
            self._end += len(made.packed) + len(made.mask)
            if made.figures is not None:
                self._figures[tile] = made.figures


def _common(first: int, length: int, tile: int) -> slice:
    return slice(max(first, tile * TILE_PX), min(first + length, (tile + 1) * TILE_PX))
