"""A raster's tiles as they come: gathered from windows, halved into overviews, packed when they are whole.

A tile is packed once, by the thread that brings its last pixel, and then only lies in a file until the raster
is put together; what is in hand are tiles that are not whole yet.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import IO, Any

import cv2
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from geomosaic.constants import sourced, tuned

TILE_PX = sourced(512, "px", "GeoTIFF tile: smaller is more to look up; larger more to read", "GDAL: COG")
_MOST_OVERVIEWS = tuned(7, "halvings", "of a 512-row block, then four rows: more would leave it none")
_EFFORT = tuned(2, "ISA-L level", "1 gains 1 % less; 3 takes a quarter longer for half a percent")
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class TileKind:
    """What tiles hold: bands of a type, and whether a mask goes with them, as with an image; without one they
    are numbers that have no mean: of four, an overview takes the first."""

    bands: int
    dtype: np.dtype[Any]
    masked: bool = True

    def packed(self, pixels: NDArray[Any]) -> bytes:
        """A tile's pixels (h, w, bands), filled up with zeros to its full size, as TIFF's predictors 2 (of
        whole numbers) and 3 (of others) and deflate have them (TIFF 6.0, section 14; Adobe's Photoshop TIFF
        Technical Note 3)."""
        return _deflated(_less_neighbours(_full(pixels)))

    def tile(self, pixels: NDArray[Any], valid: Flags, *, first: bool = True) -> PackedTile | None:
        """A whole tile's pixels (h, w, bands), 0 where not valid (h, w); None where none is. first: of the
        raster itself, not of an overview."""
        if not valid.any():
            return None
        if not self.masked:
            return PackedTile(self.packed(pixels), b"", None, pixels[::2, ::2], valid[::2, ::2])
        figures = _figures(pixels, valid) if first else None
        return PackedTile(self.packed(pixels), packed_mask(valid), figures, *halved(pixels, valid))

    def over(
        self, tiles: Mapping[tuple[int, int], PackedTile | None], height: int, width: int
    ) -> PackedTile | None:
        """The next overview's tile, of height x width pixels, over tiles: of those that show anything, by
        their place (down, across) in it."""
        pixels = np.zeros((height, width, self.bands), self.dtype)
        valid = np.zeros((height, width), bool)
        half = TILE_PX // 2
        for (i, j), tile in tiles.items():
            if tile is not None and tile.half is not None and tile.half_valid is not None:
                rows, cols = tile.half_valid.shape
                at = np.s_[i * half : i * half + rows, j * half : j * half + cols]
                pixels[at], valid[at] = tile.half, tile.half_valid
        return self.tile(pixels, valid, first=False)

    def empty(self) -> tuple[bytes, bytes]:
        """A tile without a valid pixel, and its mask's; none without one."""
        pixels = np.zeros((TILE_PX, TILE_PX * self.bands), self.dtype)
        return _deflated(pixels), packed_mask(np.zeros((1, 1), bool)) if self.masked else b""


def packed_mask(valid: Flags) -> bytes:
    """A tile's mask, a bit a pixel."""
    return _deflated(np.packbits(_full(valid), axis=1))


def _full(pixels: NDArray[Any]) -> NDArray[Any]:
    if pixels.shape[:2] == (TILE_PX, TILE_PX):
        return pixels
    full = np.zeros((TILE_PX, TILE_PX, *pixels.shape[2:]), pixels.dtype)
    full[: pixels.shape[0], : pixels.shape[1]] = pixels
    return full


def _less_neighbours(pixels: NDArray[Any]) -> NDArray[Any]:
    rows, _, bands = pixels.shape
    flat = pixels.reshape(rows, -1)
    if pixels.dtype.kind == "f":  # the bytes of a row's values apart, the highest first
        flat = np.ascontiguousarray(flat, pixels.dtype.newbyteorder(">")).view(np.uint8)
        flat = flat.reshape(rows, -1, pixels.dtype.itemsize).transpose(0, 2, 1).reshape(rows, -1)
    out = np.array(flat)
    out[:, bands:] -= flat[:, :-bands]
    return out


def _deflated(values: NDArray[Any]) -> bytes:
    little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return isal_zlib.compress(little.data.cast("B"), _EFFORT)


@dataclass(frozen=True)
class PackedTile:
    """What is left of a tile that shows something: its bytes and its mask's, packed; of an image's its
    figures, where it is none of an overview, and its part of the next overview: pixels and valid ones."""

    packed: bytes
    mask: bytes
    figures: NDArray[np.float64] | None
    half: NDArray[Any] | None
    half_valid: Flags | None


@dataclass
class _Gathered:
    """A tile in the making: pixels and valid ones, once there are any; how many pixels came."""

    pixels: NDArray[Any] | None = None
    valid: Flags | None = None
    count: int = 0


@dataclass(frozen=True)
class RasterLevel:
    """A raster or an overview of it: its size, and of each tile (down, across) where it lies in the file of
    tiles: first byte, bytes of its pixels, of its mask; 0 bytes of a tile without a valid pixel."""

    width: int
    height: int
    places: NDArray[np.int64]


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
            if not overviews or shape == (1, 1) or len(self.levels) > _MOST_OVERVIEWS:
                break
            width, height = -(-width // 2), -(-height // 2)
        self._lock, self._end = threading.Lock(), 0
        self._gathered: list[dict[tuple[int, int], _Gathered]] = [{} for _ in self.levels]
        self._figures: dict[tuple[int, int], NDArray[np.float64]] = {}

    def add(self, col: int, row: int, pixels: NDArray[Any], valid: Flags) -> None:
        """A window's pixels (h, w, bands), 0 where not valid (h, w)."""
        some = bool(valid.any())
        self._add(0, col, row, valid.shape, pixels if some else None, valid if some else None)

    def add_nothing(self, col: int, row: int, width: int, height: int) -> None:
        """A window without a valid pixel."""
        self._add(0, col, row, (height, width), None, None)

    def finish(self) -> None:
        """No more will come."""
        for level, gathered in enumerate(self._gathered):
            for at in sorted(gathered):
                tile = gathered.pop(at)
                self._whole(level, at, tile.pixels, tile.valid)

    @property
    def in_hand(self) -> int:
        """Tiles, of all levels, that some of their pixels are held of."""
        return sum(tile.pixels is not None for gathered in self._gathered for tile in gathered.values())

    def statistics(self) -> NDArray[np.float64] | None:
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

    def _add(
        self, level: int, col: int, row: int, shape: tuple[int, ...], pixels: Any, valid: Flags | None
    ) -> None:
        height, width = shape
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
        self, level: int, tile: tuple[int, int], at: tuple[slice, ...], pixels: Any, valid: Flags | None
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

    def _whole(self, level: int, tile: tuple[int, int], pixels: Any, valid: Flags | None) -> None:
        self.put(level, tile, None if valid is None else self.kind.tile(pixels, valid, first=level == 0))

    def put(self, level: int, tile: tuple[int, int], made: PackedTile | None) -> None:
        """A whole tile (down, across), and its part of the next overview."""
        self._lay(level, tile, made)
        if level + 1 < len(self.levels):
            of, (i, j), half = self.levels[level], tile, TILE_PX // 2
            height, width = min(TILE_PX, of.height - i * TILE_PX), min(TILE_PX, of.width - j * TILE_PX)
            shape = -(-height // 2), -(-width // 2)
            pixels, valid = (None, None) if made is None else (made.half, made.half_valid)
            self._add(level + 1, j * half, i * half, shape, pixels, valid)

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


def _figures(pixels: NDArray[Any], valid: Flags) -> NDArray[np.float64]:
    """Count, least, most, mean and mean square of valid pixels by band, (5, bands)."""
    bands, mask = pixels.shape[2], valid.view(np.uint8)
    mean, sd = (np.asarray(of, np.float64).ravel() for of in cv2.meanStdDev(pixels, mask=mask))
    ends = [cv2.minMaxLoc(np.ascontiguousarray(pixels[..., k]), mask)[:2] for k in range(bands)]
    count = np.full(bands, np.count_nonzero(valid))
    return np.array([count, *np.transpose(ends), mean, mean**2 + sd**2], np.float64)


def halved(pixels: NDArray[Any], valid: Flags) -> tuple[NDArray[Any], Flags]:
    """Means of 2 x 2 pixels (h, w, bands), of the valid ones among them; what is left over at an edge stands
    for itself."""
    rows, cols = valid.shape
    if rows % 2 or cols % 2:
        wider = ((0, rows % 2), (0, cols % 2))
        pixels, valid = np.pad(pixels, (*wider, (0, 0))), np.pad(valid, wider)
    bands = pixels.shape[-1]
    size = pixels.shape[1] // 2, pixels.shape[0] // 2
    means = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
    means = means.reshape(size[1], size[0], bands)
    if valid.all():
        return means, np.ones(means.shape[:2], dtype=bool)
    corners = np.stack([valid[i::2, j::2] for i in (0, 1) for j in (0, 1)])
    count = np.asarray(corners.sum(axis=0, dtype=np.uint8))
    at = np.nonzero((count > 0) & (count < len(corners)))
    four = np.stack([pixels[i::2, j::2][at] for i in (0, 1) for j in (0, 1)])
    of_valid = np.where(corners[:, *at, None], four, 0)
    found = of_valid.sum(axis=0, dtype=np.float64) / count[at][:, None]
    means[at] = (found if pixels.dtype.kind == "f" else np.rint(found)).astype(means.dtype)
    means[count == 0] = 0
    return means, count > 0
