"""A raster's tiles: packed as GeoTIFF has them, halved for the next overview."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats
from geomosaic.constants import sourced, tuned

TILE_PX = sourced(512, "px", "of the file, blended and resampled at once; larger takes memory", "GDAL: COG")
_EFFORT = tuned(2, "ISA-L level", "1 gains 1 % less; 3 takes a quarter longer for half a percent")


@dataclass(frozen=True)
class TileKind:
    """What tiles hold: bands of a type, and whether a mask goes with them, as with an image. Pixels without a
    mask are numbers that have no mean. An overview takes the first of four."""

    bands: int
    dtype: np.dtype[Any]
    masked: bool = True

    def packed(self, pixels: NDArray[Any]) -> bytes:
        """A tile's pixels (h, w, bands), padded with zeros to its full size, encoded by TIFF's predictor and
        deflate. Predictor 2 is for whole numbers, 3 for others (TIFF 6.0, section 14; Adobe's Photoshop TIFF
        Technical Note 3)."""
        return _deflated(_less_neighbours(_full(pixels)))

    def tile(self, pixels: NDArray[Any], valid: Bools, *, first: bool = True) -> PackedTile | None:
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


def packed_mask(valid: Bools) -> bytes:
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
    """What is left of a tile that shows something.

    packed, mask: its compressed bytes and its mask's. figures: of an image's tile that is none of an
    overview, see `_figures`. half, half_valid: its part of the next overview, pixels and valid ones.
    """

    packed: bytes
    mask: bytes
    figures: Floats | None
    half: NDArray[Any] | None
    half_valid: Bools | None


def _figures(pixels: NDArray[Any], valid: Bools) -> Floats:
    """Count, least, most, mean and mean square of valid pixels by band, (5, bands)."""
    bands, mask = pixels.shape[2], valid.view(np.uint8)
    mean, sd = (np.asarray(of, np.float64).ravel() for of in cv2.meanStdDev(pixels, mask=mask))
    ends = [cv2.minMaxLoc(np.ascontiguousarray(pixels[..., k]), mask)[:2] for k in range(bands)]
    count = np.full(bands, np.count_nonzero(valid))
    return np.array([count, *np.transpose(ends), mean, mean**2 + sd**2], np.float64)


def halved(pixels: NDArray[Any], valid: Bools) -> tuple[NDArray[Any], Bools]:
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
