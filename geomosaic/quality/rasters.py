"""Rasters as the judge reads them: one band of luma with its valid pixels, on the mosaic's grid."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from rasterio import Affine
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import RasterioError
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from geomosaic.arrays import Bools, Bytes, Floats32
from geomosaic.constants import sourced
from geomosaic.doors.raster import REFERENCE, Raster, open_raster, reading
from geomosaic.errors import FileError, InputError
from geomosaic.projection.lattice import MOST_OFF_PX
from geomosaic.quality.ssim import luma

RGB: Final = ("red", "green", "blue")
_OPAQUE = sourced({"int16": 32767.0}, "alpha", "of opaque pixels, where it is not 255", "GDAL, DST_ALPHA_MAX")


def open_map(path: Path) -> Raster:
    """An open raster with a georeference. Raises `FileError`."""
    dataset = open_raster(path, REFERENCE)
    if dataset.crs is None or dataset.transform.is_identity:
        dataset.close()
        raise FileError("has no coordinate reference system", file=path, fix=REFERENCE.fix)
    return dataset


def pixel_m(dataset: Raster, path: Path) -> tuple[float, float]:
    """Side of the pixel in metres, and metres per unit of the map."""
    if not dataset.crs.is_projected:
        raise FileError("is not in a map projection", file=path, fix="warp it to a projected CRS first")
    metres = float(dataset.crs.linear_units_factor[1])
    return float(np.sqrt(abs(dataset.transform.determinant))) * metres, metres


def on_grid_of(mosaic: Raster, other: Raster, path: Path, transform: Affine | None = None) -> WarpedVRT:
    """The other raster (cubic) on the mosaic's grid, or another of its size; `path` names it in errors."""
    alpha = ColorInterp.alpha in other.colorinterp
    try:
        return WarpedVRT(
            other,
            crs=mosaic.crs,
            transform=mosaic.transform if transform is None else transform,
            width=mosaic.width,
            height=mosaic.height,
            resampling=Resampling.cubic,
            tolerance=MOST_OFF_PX,
            add_alpha=not alpha,
        )
    except RasterioError as error:
        raise InputError(
            "can't be brought into the mosaic's CRS", file=path, fix="warp it to the mosaic's CRS first"
        ) from error


def colour_bands(dataset: Raster) -> list[int]:
    """The numbers of a raster's red, green and blue band: by their names, else the first three; or of the one
    grey band."""
    colours = [i for i, c in zip(dataset.indexes, dataset.colorinterp, strict=True) if c != ColorInterp.alpha]
    if len(colours) < 3:
        return colours[:1]
    number = {(dataset.descriptions[i - 1] or "").lower(): i for i in colours}
    return [number[c] for c in RGB] if number.keys() >= set(RGB) else colours[:3]


def mask_of(
    dataset: Raster | WarpedVRT, window: Window | None = None, shape: tuple[int, int] | None = None
) -> Bytes:
    """The mask (rows, cols) of a window, 0 to 255, at a reduced shape if one is given.

    It is that of an alpha band of any type. GDAL takes only those of uint8 and uint16 for masks.
    """
    alpha = [i for i, c in zip(dataset.indexes, dataset.colorinterp, strict=True) if c == ColorInterp.alpha]
    kind = dataset.dtypes[0]
    if not alpha or kind in ("uint8", "uint16"):
        return np.asarray(dataset.dataset_mask(window=window, out_shape=shape))
    opacity = dataset.read(alpha[-1], window=window, out_shape=shape) / _OPAQUE.get(kind, 255.0)
    return np.asarray(np.rint(255.0 * np.clip(opacity, 0.0, 1.0)), np.uint8)


def read_luma(
    dataset: Raster, window: Window | None, shape: tuple[int, int] | None = None
) -> tuple[Floats32, Bools]:
    """Luma and valid pixels of a window, at a reduced shape if one is given."""
    colours = colour_bands(dataset)
    with reading(Path(dataset.name)):
        bands = dataset.read(
            colours,
            window=window,
            out_shape=None if shape is None else (len(colours), *shape),
            resampling=Resampling.nearest if shape is None else Resampling.average,
        )
        valid = mask_of(dataset, window, shape) == 255
    image = luma(bands)
    valid &= np.isfinite(image)
    return np.where(valid, image, np.float32(0.0)), valid


def blocks(height: int, width: int, side: int) -> Iterator[Window]:
    """Square windows that fill a raster, row by row."""
    for row in range(0, height, side):
        for col in range(0, width, side):
            yield Window(col, row, min(side, width - col), min(side, height - row))


def within(window: Window, outer: Window) -> tuple[slice, slice]:
    """The rows and cols of a window in those of one around it."""
    row, col = window.row_off - outer.row_off, window.col_off - outer.col_off
    return slice(row, row + window.height), slice(col, col + window.width)


def grown(window: Window, margin: int, height: int, width: int) -> Window:
    """A window with a margin around it, as far as the raster goes."""
    row, col = max(0, window.row_off - margin), max(0, window.col_off - margin)
    bottom = min(height, window.row_off + window.height + margin)
    right = min(width, window.col_off + window.width + margin)
    return Window(col, row, right - col, bottom - row)
