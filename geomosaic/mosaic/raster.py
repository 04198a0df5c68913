"""A composed raster on disk, written by windows: tiled, uncompressed, with an internal mask, and if asked for
with overviews, of which each block of rows brings its part."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from osgeo import gdal, gdal_array, osr

from geomosaic.constants import CHOSEN, Because
from geomosaic.doors.gdal_failures import close, gdal_failures, gdal_options
from geomosaic.mosaic.model import OutputGrid
from geomosaic.mosaic.window import Composed

TILE_PX: Annotated[
    int,
    Because(
        "px",
        "side of a tile of a GeoTIFF: smaller ones are many to look up, larger ones much to read for a pixel",
        "GDAL, COG driver: BLOCKSIZE's default",
    ),
] = 512
BLOCK_ROWS: Final = TILE_PX
_MOST_OVERVIEWS: Annotated[
    int,
    Because(
        "halvings",
        "a block's 512 rows are halved so often that its part of the smallest overview is four rows",
        CHOSEN,
    ),
] = 7
_OPTIONS: Final = (
    "TILED=YES",
    f"BLOCKXSIZE={TILE_PX}",
    f"BLOCKYSIZE={TILE_PX}",
    "BIGTIFF=IF_SAFER",
    "SPARSE_OK=YES",
    "INTERLEAVE=PIXEL",
)
_SETTINGS: Final = {"GDAL_TIFF_INTERNAL_MASK": "YES", "GDAL_TIFF_OVR_BLOCKSIZE": str(TILE_PX)}
_COLOURS: Final = {
    1: (gdal.GCI_GrayIndex,),
    3: (gdal.GCI_RedBand, gdal.GCI_GreenBand, gdal.GCI_BlueBand),
}
Flags = NDArray[np.bool_]


class Raster:
    """An open GeoTIFF. Tiles lie in the file as they were written, so that equal mosaics are equal bytes."""

    def __init__(
        self, dataset: Any, *, by_blocks: bool = False, overviews: int = 0, sources: Any | None = None
    ) -> None:
        bands = [dataset.GetRasterBand(k + 1) for k in range(dataset.RasterCount)]
        self._levels = [bands, *([b.GetOverview(k) for b in bands] for k in range(overviews))]
        self._sources, self._width, self._by_blocks = sources, dataset.RasterXSize, by_blocks
        self._block: tuple[int, NDArray[Any], Flags] | None = None

    def write(self, composed: Composed) -> bool:
        """One window, and whether something was written: by blocks of rows a window waits, with those to its
        left, for the block's last one. Without any valid pixel they take no room."""
        window = composed.window
        if not self._by_blocks:
            self._write(window.col, window.row, composed.pixels, composed.valid)
            if self._sources is not None and composed.valid.any():
                source = composed.source.astype(
                    gdal_array.GDALTypeCodeToNumericTypeCode(self._sources.DataType)
                )
                self._sources.WriteArray(source, window.col, window.row)
                self._sources.FlushCache()
            return True
        if self._block is None or self._block[0] != window.row:
            shape = window.height, self._width
            pixels = np.zeros((*shape, composed.pixels.shape[-1]), composed.pixels.dtype)
            self._block = window.row, pixels, np.zeros(shape, bool)
        cols = slice(window.col, window.col + window.width)
        self._block[1][:, cols], self._block[2][:, cols] = composed.pixels, composed.valid
        if cols.stop < self._width:
            return False
        self._write(0, *self._block)
        return True

    def _write(self, col: int, row: int, pixels: NDArray[Any], valid: Flags) -> None:
        if not valid.any():
            return
        for level, bands in enumerate(self._levels):
            if level:
                pixels, valid = halved(pixels, valid)
            at = col >> level, row >> level
            for k, band in enumerate(bands):
                band.WriteArray(pixels[..., k], *at)
            bands[0].FlushCache()
            mask = bands[0].GetMaskBand()
            mask.WriteArray(valid.view(np.uint8) * np.uint8(255), *at)
            mask.FlushCache()


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
    count = valid.reshape(size[1], 2, size[0], 2).sum(axis=(1, 3), dtype=np.uint8)
    some = (count > 0) & (count < 4)
    four = np.where(valid[..., None], pixels, 0).reshape(size[1], 2, size[0], 2, bands)
    of_valid = four.sum(axis=(1, 3), dtype=np.float64 if pixels.dtype.kind == "f" else np.int64)
    found = of_valid[some] / count[some][:, None]
    means[some] = (found if pixels.dtype.kind == "f" else np.rint(found)).astype(means.dtype)
    means[count == 0] = 0
    return means, count > 0


@contextmanager
def writing_mosaic(
    path: Path,
    grid: OutputGrid,
    bands: int,
    dtype: str,
    sources: Path | None,
    frames: Sequence[str],
    band_names: Sequence[str] = (),
) -> Iterator[Raster]:
    """Files on the map to write windows into; complete when the block ends.

    band_names: of each band, as a rig's have; then none is a colour. sources: where the frame index raster
    goes: 0 where there is no frame, else the frame's index + 1; its tags name the frames.
    Raises: `OSError` (with `ENOSPC` where the disk is full) if they can't be written.
    """
    with ExitStack() as files:
        mosaic = files.enter_context(_created(path, grid.width_px, grid.height_px, bands, dtype, grid))
        colours = _COLOURS.get(bands, ())
        if band_names:
            colours = (gdal.GCI_GrayIndex, *[gdal.GCI_Undefined] * (bands - 1))
        for k, colour in enumerate(colours):
            mosaic.GetRasterBand(k + 1).SetColorInterpretation(colour)
        for k, name in enumerate(band_names):
            mosaic.GetRasterBand(k + 1).SetDescription(name)
        mosaic.CreateMaskBand(gdal.GMF_PER_DATASET)
        index = None
        if sources is not None:
            kind = "uint16" if len(frames) < 65535 else "uint32"
            more = ("COMPRESS=DEFLATE",)
            made = files.enter_context(_created(sources, grid.width_px, grid.height_px, 1, kind, grid, more))
            made.SetMetadata({f"FRAME_{i + 1}": name for i, name in enumerate(frames)})
            index = made.GetRasterBand(1)
            index.SetNoDataValue(0)
            index.SetDescription("index of the frame that made the pixel, from 1")
        yield Raster(mosaic, sources=index)


@contextmanager
def writing_scene(
    path: Path, width: int, height: int, dtype: str, bit_depth: int, rpc: Mapping[str, str] | None
) -> Iterator[Raster]:
    """A raster of one band without a map, with overviews, to write blocks of rows into.

    Raises: `OSError` (with `ENOSPC` where the disk is full) if it can't be written.
    """
    overviews = 0
    while overviews < _MOST_OVERVIEWS and max(width, height) > TILE_PX << overviews:
        overviews += 1
    with _created(path, width, height, 1, dtype) as dataset:
        if rpc is not None:
            dataset.SetMetadata(dict(rpc), "RPC")
        dataset.GetRasterBand(1).SetMetadataItem("NBITS", str(bit_depth))
        dataset.CreateMaskBand(gdal.GMF_PER_DATASET)
        if overviews:
            dataset.BuildOverviews("NONE", [2 << k for k in range(overviews)])
        yield Raster(dataset, by_blocks=True, overviews=overviews)


@contextmanager
def _created(
    path: Path,
    width: int,
    height: int,
    bands: int,
    dtype: str,
    grid: OutputGrid | None = None,
    options: Sequence[str] = (),
) -> Iterator[Any]:
    with gdal_failures(path), gdal_options(_SETTINGS):
        kind = gdal_array.NumericTypeCodeToGDALTypeCode(np.dtype(dtype))
        driver = gdal.GetDriverByName("GTiff")
        dataset = driver.Create(str(path), width, height, bands, kind, [*_OPTIONS, *options])
        try:
            if grid is not None:
                crs = osr.SpatialReference()
                crs.SetFromUserInput(grid.crs)
                dataset.SetSpatialRef(crs)
                dataset.SetGeoTransform(grid.geotransform)
            yield dataset
        finally:
            close(dataset)
