"""The composed raster on disk, written by windows: tiled, uncompressed, with an internal mask."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError
from rasterio.windows import Window as RasterWindow

from geomosaic.mosaic.model import OutputGrid
from geomosaic.mosaic.plan import Window
from geomosaic.mosaic.window import Composed

TILE_PX = 512
_LITTLE_BYTES = 1 << 20
_SHARED: dict[str, Any] = {
    "driver": "GTiff",
    "tiled": True,
    "blockxsize": TILE_PX,
    "blockysize": TILE_PX,
    "BIGTIFF": "IF_SAFER",
    "SPARSE_OK": True,
}


class MosaicRaster:
    """Open files of a composition: the mosaic, and if asked for the index of which frame made each pixel."""

    def __init__(self, mosaic: Any, sources: Any | None) -> None:
        self._mosaic = mosaic
        self._sources = sources

    def write(self, composed: Composed) -> None:
        """One window. Those without any valid pixel take no room in the files."""
        if not composed.valid.any():
            return
        at = _raster_window(composed.window)
        self._mosaic.write(np.moveaxis(composed.pixels, -1, 0), window=at)
        self._mosaic.write_mask(composed.valid.astype(np.uint8) * 255, window=at)
        if self._sources is not None:
            self._sources.write(composed.source.astype(self._sources.dtypes[0]), 1, window=at)


@contextmanager
def writing_mosaic(
    path: Path,
    grid: OutputGrid,
    bands: int,
    dtype: str,
    sources: Path | None,
    frames: Sequence[str],
    band_names: Sequence[str] = (),
) -> Iterator[MosaicRaster]:
    """Files to write windows into; complete when the block ends.

    band_names: of each band, as a rig's have; then none is a colour. sources: where the frame index raster
    goes: 0 where there is no frame, else the frame's index + 1; its tags name the frames.
    Raises: `OSError` (with `ENOSPC` where the disk is full) if they can't be written.
    """
    shape = {
        "width": grid.width_px,
        "height": grid.height_px,
        "crs": rasterio.CRS.from_user_input(grid.crs),
        "transform": rasterio.Affine.from_gdal(*grid.geotransform),
    }
    colours = {1: [ColorInterp.gray], 3: [ColorInterp.red, ColorInterp.green, ColorInterp.blue]}
    with _full_disk_told(path), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        mosaic = rasterio.open(path, "w", count=bands, dtype=dtype, interleave="pixel", **shape, **_SHARED)
        with mosaic:
            if band_names:
                mosaic.colorinterp = [ColorInterp.gray, *[ColorInterp.undefined] * (bands - 1)]
                mosaic.descriptions = tuple(band_names)
            elif bands in colours:
                mosaic.colorinterp = colours[bands]
            if sources is None:
                yield MosaicRaster(mosaic, None)
                return
            index_dtype = "uint16" if len(frames) < 65535 else "uint32"
            with rasterio.open(
                sources, "w", count=1, dtype=index_dtype, nodata=0, compress="deflate", **shape, **_SHARED
            ) as index:
                index.update_tags(**{f"FRAME_{i + 1}": name for i, name in enumerate(frames)})
                index.set_band_description(1, "index of the frame that made the pixel, from 1")
                yield MosaicRaster(mosaic, index)


@contextmanager
def _full_disk_told(path: Path) -> Iterator[None]:
    try:
        yield
    except RasterioError as error:
        full = shutil.disk_usage(path.parent).free < _LITTLE_BYTES
        raise OSError(errno.ENOSPC if full else errno.EIO, str(error.__cause__ or error)) from error


def _raster_window(window: Window) -> RasterWindow:
    return RasterWindow(window.col, window.row, window.width, window.height)
