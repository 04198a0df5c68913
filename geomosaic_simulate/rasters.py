"""The true ortho and the true DEM as GeoTIFFs in the map CRS, written window by window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.windows import Window

from geomosaic.arrays import Bytes, Floats
from geomosaic.doors.raster import OWN, open_raster
from geomosaic_simulate.buildings import Building
from geomosaic_simulate.landscape import COVERS, Bounds, Landscape
from geomosaic_simulate.relief import RasterRelief, Relief
from geomosaic_simulate.spread import in_threads
from geomosaic_simulate.standing import heights_on_grid
from geomosaic_simulate.terrain import BLOCK_PX, TILE_MARGIN_PX, GroundImage, cover_mask
from geomosaic_simulate.write import whole

MARGIN_PX = 8
_DEM_ROWS = 512


@dataclass(frozen=True)
class Texture:
    """The ground's image as frames see it: a continuous surface, bicubic through these samples.

    pixels: (rows, cols, 3) RGB, kept on disk and sparse; west_m, north_m: its outer corner.
    """

    pixels: Bytes
    west_m: float
    north_m: float
    pixel_m: float

    def window(self, bounds_m: Bounds) -> tuple[Bytes, float, float]:
        """The part that covers the bounds with a margin: pixels (rows, cols, 3), west, north."""
        west, south, east, north = bounds_m
        rows, cols = self.pixels.shape[:2]
        col = max(int((west - self.west_m) / self.pixel_m) - MARGIN_PX, 0)
        row = max(int((self.north_m - north) / self.pixel_m) - MARGIN_PX, 0)
        end_col = min(int((east - self.west_m) / self.pixel_m) + MARGIN_PX, cols)
        end_row = min(int((self.north_m - south) / self.pixel_m) + MARGIN_PX, rows)
        corner = self.west_m + col * self.pixel_m, self.north_m - row * self.pixel_m
        return np.array(self.pixels[row:end_row, col:end_col]), *corner


def write_ortho(
    path: Path,
    scratch: Path,
    crs: str,
    ground: GroundImage,
    seen_m: Sequence[Bounds],
    footprints_m: Sequence[Floats | None],
    progress: Callable[[int, int], None],
) -> Texture:
    """The ground's image wherever a frame looks, RGB with an internal mask of the footprints' union.

    Each pixel of the ortho is the mean of the ground over its square: what a camera of that ground pixel
    sees from straight above. The samples themselves go to the texture in the file `scratch`. Blocks
    outside every frame's box stay empty; pixels between a footprint and its box hold the ground too,
    but are masked.

    Args: seen_m: each frame's west, south, east, north; footprints_m: each frame's outline (n, 2), None of
        those that don't belong in a map.
    """
    side = BLOCK_PX * ground.pixel_m
    margin = MARGIN_PX * ground.pixel_m
    touched: dict[tuple[int, int], list[int]] = {}
    for i, (west, south, east, north) in enumerate(seen_m):
        rows = range(int(np.floor(-(north + margin) / side)), int(np.floor(-(south - margin) / side)) + 1)
        cols = range(int(np.floor((west - margin) / side)), int(np.floor((east + margin) / side)) + 1)
        for row in rows:
            for col in cols:
                touched.setdefault((row, col), []).append(i)
    blocks = np.array(list(touched))
    (row_0, col_0), (row_1, col_1) = blocks.min(axis=0), blocks.max(axis=0) + 1
    west_m, north_m = float(col_0) * side, -float(row_0) * side
    size = int(row_1 - row_0) * BLOCK_PX, int(col_1 - col_0) * BLOCK_PX
    texture = np.memmap(scratch, np.uint8, "w+", shape=(*size, 3))
    inner = slice(TILE_MARGIN_PX, -TILE_MARGIN_PX)
    profile = {
        "driver": "GTiff",
        "width": size[1],
        "height": size[0],
        "count": 3,
        "dtype": "uint8",
        "photometric": "RGB",
        "crs": crs,
        "transform": Affine(ground.pixel_m, 0.0, west_m, 0.0, -ground.pixel_m, north_m),
        "tiled": True,
        "blockxsize": BLOCK_PX,
        "blockysize": BLOCK_PX,
        "interleave": "pixel",
        "compress": "deflate",
        "predictor": 2,
        "zlevel": 1,
        "bigtiff": "if_safer",
    }
    with (
        whole(path) as part,
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(part, "w", **profile) as out,
    ):
        blocks_at = sorted(touched)
        tiles = in_threads(lambda at: ground.tile(at[1], at[0]), blocks_at)
        for done, ((row, col), tile) in enumerate(zip(blocks_at, tiles, strict=True)):
            y, x = int(row - row_0) * BLOCK_PX, int(col - col_0) * BLOCK_PX
            window = Window(x, y, BLOCK_PX, BLOCK_PX)
            texture[y : y + BLOCK_PX, x : x + BLOCK_PX] = tile[inner, inner]
            out.write(np.moveaxis(square_mean(tile)[inner, inner], -1, 0), window=window)
            frames = [f for i in touched[row, col] if (f := footprints_m[i]) is not None]
            out.write_mask(_mask(ground, row, col, frames), window=window)
            progress(done + 1, len(touched))
    return Texture(texture, west_m, north_m, ground.pixel_m)


def write_cover(path: Path, ortho: Path, landscape: Landscape) -> None:
    """What covers the ortho's pixels, on its grid: 0 land, then the number of `COVERS` (1 water, ...)."""
    with open_raster(ortho, OWN) as like:
        profile = {**like.profile, "count": 1, "nodata": None}
        t, width, height = like.transform, like.width, like.height
    for key in ("photometric", "interleave"):
        profile.pop(key, None)
    with whole(path) as part, rasterio.open(part, "w", **profile) as out:
        for top in range(0, height, BLOCK_PX):
            band = np.zeros((min(BLOCK_PX, height - top), width), dtype=np.uint8)
            for number, cover in enumerate(COVERS, 1):
                mask = cover_mask(landscape, cover, t.c, t.f - top * t.a, t.a, band.shape)
                band[mask >= 128] = number
            out.write(band, 1, window=Window(0, top, width, len(band)))
        out.update_tags(1, COVERS=", ".join(f"{n} {cover}" for n, cover in enumerate(COVERS, 1)))


def square_mean(texture: Bytes) -> Bytes:
    """The mean over each pixel's square of the bicubic surface through the samples (2 x 2, as `render`)."""
    mean = cv2.sepFilter2D(texture, cv2.CV_32F, _SQUARE, _SQUARE, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.clip(np.round(mean), 0.0, 255.0), dtype=np.uint8)


def _cubic(t: NDArray[np.floating]) -> Floats:
    """The cubic convolution kernel of Keys 1981 with a = -0.75, which OpenCV interpolates with."""
    d, a = np.abs(t), -0.75
    near = ((a + 2.0) * d - (a + 3.0)) * d * d + 1.0
    far = ((a * d - 5.0 * a) * d + 8.0 * a) * d - 4.0 * a
    return np.asarray(np.where(d < 1.0, near, np.where(d < 2.0, far, 0.0)), dtype=np.float64)


_TAPS = np.arange(-2.0, 3.0)
_SQUARE = (_cubic(_TAPS - 0.25) + _cubic(_TAPS + 0.25)) / 2.0


def _mask(ground: GroundImage, row: int, col: int, footprints_m: Sequence[Floats]) -> Bytes:
    """255 where a pixel's centre lies in a footprint."""
    mask = np.zeros((BLOCK_PX, BLOCK_PX), dtype=np.uint8)
    for outline in footprints_m:
        px = outline / ground.pixel_m * [1.0, -1.0] - [col * BLOCK_PX, row * BLOCK_PX] - 0.5
        cv2.fillPoly(mask, [np.round(px * 64.0).astype(np.int32)], (255, 255, 255), shift=6)
    return mask


def write_heights(
    path: Path,
    crs: str,
    relief: Relief | RasterRelief,
    bounds_m: Bounds,
    spacing_m: float,
    buildings: Sequence[Building] = (),
    trees: Floats | None = None,
) -> None:
    """Ellipsoidal heights at pixel centres (float32), with the given roofs and trees (`World.trees`)."""
    west = float(np.floor(bounds_m[0] / spacing_m)) * spacing_m
    north = float(np.ceil(bounds_m[3] / spacing_m)) * spacing_m
    cols = int(np.ceil((bounds_m[2] - west) / spacing_m))
    rows = int(np.ceil((north - bounds_m[1]) / spacing_m))
    profile = {
        "driver": "GTiff",
        "width": cols,
        "height": rows,
        "count": 1,
        "dtype": "float32",
        "crs": crs,
        "transform": Affine(spacing_m, 0.0, west, 0.0, -spacing_m, north),
        "tiled": True,
        "compress": "deflate",
        "predictor": 3,
        "bigtiff": "if_safer",
    }
    with whole(path) as part, rasterio.open(part, "w", **profile) as out:
        out.update_tags(1, HEIGHTS="ellipsoidal, WGS 84, metres")
        for top in range(0, rows, _DEM_ROWS):
            n = min(_DEM_ROWS, rows - top)
            place = west, north - top * spacing_m, spacing_m, (n, cols)
            height, _ = heights_on_grid(relief, buildings, trees, *place)
            out.write(height, 1, window=Window(0, top, cols, n))
