"""Web Mercator tiles of 256 px: the finest resampled from the mosaic, each coarser one the mean of four."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from rasterio import Affine
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT

from geomosaic.arrays import Bytes
from geomosaic.doors.gdal_failures import Progress
from geomosaic.doors.raster import OWN, open_raster, reading
from geomosaic.export.shown_bands import ShownBands
from geomosaic.geodesy.antimeridian import geographic_bounds, mercator_bounds

TILE_PX: Final = 256
EQUATOR_M: Final = 40_075_016.685578488
FORMATS: Final[dict[str, tuple[int, ...]]] = {
    "png": (cv2.IMWRITE_PNG_COMPRESSION, 1),
    "webp": (cv2.IMWRITE_WEBP_QUALITY, 80),
}
"""How each is packed: PNG five times faster than at zlib's default, and a fifth larger."""
_BLOCK: Final = 8
"""Tiles a side that are resampled at once: 2048 x 2048 px."""

Place = tuple[int, int]
"""Column and row, from the north-west of the world."""


@dataclass(frozen=True)
class TilePyramid:
    """What is to be written. zooms: the coarsest and the finest. finer: whether the finest tiles' pixels are
    finer than the mosaic's, or else means of many."""

    mosaic: Path
    shown: ShownBands
    folder: Path
    zooms: tuple[int, int]
    tile_format: str
    finer: bool

    def blocks(self) -> Iterator[Place]:
        """Squares of `_BLOCK` tiles of the finest zoom that meet the mosaic's bounds."""
        with open_raster(self.mosaic, OWN) as tiff:
            bounds = geographic_bounds(tiff.crs, tiff.bounds)
        west, south, east, north = mercator_bounds(bounds, EQUATOR_M)
        side = _BLOCK * EQUATOR_M / 2.0 ** self.zooms[1]
        last = max(0, math.ceil(EQUATOR_M / side) - 1)
        left, right = (math.floor((x + EQUATOR_M / 2.0) / side) for x in (west, east))
        top, bottom = (math.floor((EQUATOR_M / 2.0 - y) / side) for y in (north, south))
        for row in range(max(top, 0), min(bottom, last) + 1):
            yield from ((col % (last + 1), row) for col in range(left, min(right, left + last) + 1))

    def write_block(self, block: Place) -> tuple[Place, Bytes | None]:
        """Writes its tiles of the finest zoom and of the coarser ones, up to that of which it is one tile.

        Returns that one's place, and half of its pixels; None if they are empty or it isn't asked for."""
        pixels = self._resampled(block)
        col, row = (_BLOCK * v for v in block)
        zoom, tiles = self.zooms[1], _BLOCK
        while pixels is not None:
            for i, j in np.ndindex(tiles, tiles):
                tile = pixels[i * TILE_PX : (i + 1) * TILE_PX, j * TILE_PX : (j + 1) * TILE_PX]
                self.write_tile(zoom, (col + j, row + i), tile)
            if zoom == self.zooms[0]:
                return block, None
            pixels = halved(pixels)
            if tiles == 1:
                break
            tiles, zoom, col, row = tiles // 2, zoom - 1, col // 2, row // 2
        return block, pixels

    def write_tile(self, zoom: int, place: Place, tile: Bytes) -> None:
        """Unless it is empty."""
        if tile[..., 3].any():
            path = self.folder / f"{zoom}" / f"{place[0]}" / f"{place[1]}.{self.tile_format}"
            path.parent.mkdir(parents=True, exist_ok=True)
            _, data = cv2.imencode(f".{self.tile_format}", tile, FORMATS[self.tile_format])
            path.write_bytes(data.tobytes())

    def _resampled(self, block: Place) -> Bytes | None:
        """Blue, green, red and opacity; None where nothing is seen."""
        side_m, size = EQUATOR_M / 2.0 ** self.zooms[1] / TILE_PX, _BLOCK * TILE_PX
        west, north = block[0] * size * side_m - EQUATOR_M / 2.0, EQUATOR_M / 2.0 - block[1] * size * side_m
        with (
            open_raster(self.mosaic, OWN) as tiff,
            reading(self.mosaic, OWN.problem, OWN.fix),
            WarpedVRT(
                tiff, crs="EPSG:3857", transform=Affine(side_m, 0.0, west, 0.0, -side_m, north), width=size,
                height=size, resampling=Resampling.bilinear if self.finer else Resampling.average,
                add_alpha=True, warp_mem_limit=64,
            ) as warped,
        ):  # fmt: skip
            seen = warped.read(warped.count) > 0
            if not seen.any():
                return None
            colours = self.shown.eight_bits(warped.read(self.shown.bands))
        if len(colours) == 1:
            colours = np.repeat(colours, 3, axis=0)
        colours[:, ~seen] = 0
        return np.dstack([*colours[::-1], seen.astype(np.uint8) * np.uint8(255)])


def write_pyramid(pyramid: TilePyramid, threads: int, progress: Progress | None) -> None:
    """Writes all tiles that show anything. Raises: what `progress` raises; `OSError` of a tile."""
    blocks, zoom = list(pyramid.blocks()), pyramid.zooms[1]
    tops: dict[Place, Bytes] = {}
    with ThreadPoolExecutor(threads) as pool:
        try:
            running = [pool.submit(pyramid.write_block, block) for block in blocks]
            for done, future in enumerate(as_completed(running), 1):
                place, pixels = future.result()
                if pixels is not None:
                    tops[place] = pixels
                if progress is not None:
                    progress(done, len(blocks))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    zoom -= _BLOCK.bit_length() - 1
    while zoom > pyramid.zooms[0]:
        zoom, above = zoom - 1, {}
        for col, row in sorted({(col // 2, row // 2) for col, row in tops}):
            tile = np.zeros((TILE_PX, TILE_PX, 4), np.uint8)
            for i, j in np.ndindex(2, 2):
                half = tops.get((2 * col + j, 2 * row + i))
                if half is not None:
                    tile[i * TILE_PX // 2 :, j * TILE_PX // 2 :][: TILE_PX // 2, : TILE_PX // 2] = half
            pyramid.write_tile(zoom, (col, row), tile)
            above[col, row] = halved(tile)
        tops = above


def halved(pixels: Bytes) -> Bytes:
    """Means of 2 x 2 pixels (rows, cols, 4), each counted by its opacity, the last band."""
    size = pixels.shape[1] // 2, pixels.shape[0] // 2
    if pixels[..., 3].min() == 255:
        return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    opacity = pixels[..., 3:].astype(np.float32)
    weighed = cv2.resize(pixels[..., :3] * opacity, size, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(opacity, size, interpolation=cv2.INTER_AREA)[..., None]
    colours = weighed / np.maximum(mean, 1e-6)
    return np.asarray(np.round(np.concatenate([colours, mean], axis=2)), np.uint8)
