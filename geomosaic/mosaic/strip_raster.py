"""The scene's raster on disk, written by blocks of rows, each with its part of every overview."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from osgeo import gdal, gdal_array

from geomosaic.mosaic.gdal_failures import close, gdal_failures, gdal_options
from geomosaic.mosaic.raster import TILE_PX

BLOCK_ROWS: Final = TILE_PX
_MOST_OVERVIEWS = 7
"""A block's rows are halved so often; its part of the smallest overview is four rows."""
Flags = NDArray[np.bool_]


class SceneRaster:
    """A tiled, uncompressed GeoTIFF with an internal mask and overviews, open for writing."""

    def __init__(self, dataset: Any, overviews: int) -> None:
        band = dataset.GetRasterBand(1)
        levels = [band, *(band.GetOverview(k) for k in range(overviews))]
        self._levels = [(level, level.GetMaskBand()) for level in levels]

    def write(self, top: int, pixels: NDArray[Any], valid: Flags) -> None:
        """A block of whole rows from `top`, a multiple of `BLOCK_ROWS`.

        Without valid pixels it takes no room. Tiles lie in the file as they were written, so that equal
        scenes are equal bytes.
        """
        if not valid.any():
            return
        for level, (band, mask) in enumerate(self._levels):
            if level:
                pixels, valid = halved(pixels, valid)
            for into, what in ((band, pixels), (mask, valid.astype(np.uint8) * 255)):
                into.WriteArray(what, 0, top >> level)
                into.FlushCache()


def halved(pixels: NDArray[Any], valid: Flags) -> tuple[NDArray[Any], Flags]:
    """Means of 2 x 2 pixels, of the valid ones among them; what is left over at an edge stands for itself."""
    rows, cols = pixels.shape
    if rows % 2 or cols % 2:
        wider = ((0, rows % 2), (0, cols % 2))
        pixels, valid = np.pad(pixels, wider), np.pad(valid, wider)
    size = pixels.shape[1] // 2, pixels.shape[0] // 2
    means = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    if valid.all():
        return means, np.ones(means.shape, dtype=bool)
    four = valid.reshape(size[1], 2, size[0], 2)
    count = four.sum(axis=(1, 3), dtype=np.uint8)
    some = (count > 0) & (count < 4)
    of_valid = np.where(valid, pixels, 0).reshape(size[1], 2, size[0], 2).sum(axis=(1, 3), dtype=np.int64)
    means = means.reshape(size[1], size[0])
    means[some] = np.rint(of_valid[some] / count[some]).astype(means.dtype)
    means[count == 0] = 0
    return means, count > 0


@contextmanager
def writing_scene(
    path: Path, width: int, height: int, dtype: str, bit_depth: int, rpc: Mapping[str, str] | None
) -> Iterator[SceneRaster]:
    """A raster to write blocks into; complete when the block ends.

    Raises: `OSError` (with `ENOSPC` where the disk is full) if it can't be written.
    """
    options = [
        "TILED=YES",
        f"BLOCKXSIZE={TILE_PX}",
        f"BLOCKYSIZE={TILE_PX}",
        "BIGTIFF=IF_SAFER",
        "SPARSE_OK=YES",
    ]
    settings = {"GDAL_TIFF_INTERNAL_MASK": "YES", "GDAL_TIFF_OVR_BLOCKSIZE": str(TILE_PX)}
    overviews = 0
    while overviews < _MOST_OVERVIEWS and max(width, height) > TILE_PX << overviews:
        overviews += 1
    with gdal_failures(path), gdal_options(settings):
        kind = gdal_array.NumericTypeCodeToGDALTypeCode(np.dtype(dtype))
        dataset = gdal.GetDriverByName("GTiff").Create(str(path), width, height, 1, kind, options)
        if rpc is not None:
            dataset.SetMetadata(dict(rpc), "RPC")
        dataset.GetRasterBand(1).SetMetadataItem("NBITS", str(bit_depth))
        dataset.CreateMaskBand(gdal.GMF_PER_DATASET)
        if overviews:
            dataset.BuildOverviews("NONE", [2 << k for k in range(overviews)])
        try:
            yield SceneRaster(dataset, overviews)
        finally:
            close(dataset)
