"""The true ortho and the true DEM as GeoTIFFs in the map CRS, written window by window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.windows import Window

from geomosaic.simulate.landscape import Bounds, Building
from geomosaic.simulate.terrain import BLOCK_PX, Ground, Relief
from geomosaic.simulate.write import whole

Floats = NDArray[np.float64]
MARGIN_PX = 8
_DEM_ROWS = 512


def write_ortho(
    path: Path,
    crs: str,
    ground: Ground,
    seen_m: Sequence[Bounds],
    footprints_m: Sequence[Floats],
    progress: Callable[[int, int], None],
) -> None:
    """The ground's picture wherever a frame looks, RGB with an internal mask of the footprints' union.

    Its grid is the ground's own, so nothing is resampled. Blocks outside every frame's box stay empty;
    pixels between a footprint and its box hold the ground too, but are masked.

    Args: seen_m: each frame's west, south, east, north; footprints_m: each frame's outline (n, 2).
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
    profile = {
        "driver": "GTiff",
        "width": int(col_1 - col_0) * BLOCK_PX,
        "height": int(row_1 - row_0) * BLOCK_PX,
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
        for done, ((row, col), frames) in enumerate(sorted(touched.items())):
            window = Window((col - col_0) * BLOCK_PX, (row - row_0) * BLOCK_PX, BLOCK_PX, BLOCK_PX)
            out.write(np.moveaxis(ground.block(col, row), -1, 0), window=window)
            out.write_mask(_mask(ground, row, col, [footprints_m[i] for i in frames]), window=window)
            progress(done + 1, len(touched))


def _mask(ground: Ground, row: int, col: int, footprints_m: Sequence[Floats]) -> NDArray[np.uint8]:
    """255 where a pixel's centre lies in a footprint."""
    mask = np.zeros((BLOCK_PX, BLOCK_PX), dtype=np.uint8)
    for outline in footprints_m:
        px = outline / ground.pixel_m * [1.0, -1.0] - [col * BLOCK_PX, row * BLOCK_PX] - 0.5
        cv2.fillPoly(mask, [np.round(px * 64.0).astype(np.int32)], (255, 255, 255), shift=6)
    return mask


def read_ortho(path: Path, bounds_m: Bounds) -> tuple[NDArray[np.uint8], float, float]:
    """The part of the ortho that covers the bounds with a margin: pixels (rows, cols, 3), west, north."""
    with rasterio.open(path) as ortho:
        west, south, east, north = bounds_m
        pixel = ortho.transform.a
        col = max(int((west - ortho.transform.c) / pixel) - MARGIN_PX, 0)
        row = max(int((ortho.transform.f - north) / pixel) - MARGIN_PX, 0)
        end_col = min(int((east - ortho.transform.c) / pixel) + MARGIN_PX, ortho.width)
        end_row = min(int((ortho.transform.f - south) / pixel) + MARGIN_PX, ortho.height)
        pixels = ortho.read(window=Window(col, row, end_col - col, end_row - row))
        corner = ortho.transform.c + col * pixel, ortho.transform.f - row * pixel
    return np.ascontiguousarray(np.moveaxis(pixels, 0, -1)), float(corner[0]), float(corner[1])


def write_heights(
    path: Path,
    crs: str,
    relief: Relief,
    bounds_m: Bounds,
    spacing_m: float,
    buildings: Sequence[Building] = (),
) -> None:
    """Ellipsoidal heights at pixel centres (float32), with the roofs of the given buildings."""
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
    east_m = west + (np.arange(cols) + 0.5) * spacing_m
    roofs = [(b, float(relief.height_at(b.easting_m, b.northing_m)) + b.height_m) for b in buildings]
    with whole(path) as part, rasterio.open(part, "w", **profile) as out:
        out.update_tags(1, HEIGHTS="ellipsoidal, WGS 84, metres")
        for top in range(0, rows, _DEM_ROWS):
            n = min(_DEM_ROWS, rows - top)
            north_m = north - (top + np.arange(n) + 0.5) * spacing_m
            height = relief.height_at(east_m[None, :], north_m[:, None]).astype(np.float32)
            height = np.ascontiguousarray(height)
            for b, roof in roofs:
                px = (b.outline_m() - [west, north]) / [spacing_m, -spacing_m] - [0.5, top + 0.5]
                if px[:, 1].max() > -1 and px[:, 1].min() < n:
                    cv2.fillPoly(height, [np.round(px * 64.0).astype(np.int32)], (roof,), shift=6)
            out.write(height, 1, window=Window(0, top, cols, n))
