"""The mosaic as a cloud-optimised GeoTIFF."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from osgeo import gdal

from geomosaic.composition.raster import COMPRESSION, SOFTWARE
from geomosaic.composition.raster import OVERVIEWS as OVERVIEWS_MADE
from geomosaic.doors.gdal_failures import GdalProgress, Progress, gdal_failures, gdal_options
from geomosaic.doors.raster import OWN, open_with_osgeo
from geomosaic.errors import InputError

COMPRESSIONS: Final[dict[str, tuple[str, ...]]] = {
    "deflate": ("PREDICTOR=YES", "LEVEL=3"),
    "zstd": ("PREDICTOR=YES",),
    "lzw": ("PREDICTOR=YES",),
    "lerc": (),
    "webp": (),
    "jpeg": (),
}
"""Creation options that go with each compression; the last two lose a little and take 8 bits only."""
LOSSY: Final = ("webp", "jpeg")
LOSSLESS: Final = ("deflate", "zstd", "lzw")
LERC: Final = "lerc"
OVERVIEWS: Final = ("average", "cubic", "bilinear", "lanczos", "nearest")
_BLOCK_PX = 512
_CACHE_BYTES = 256 << 20
_COPIED_BYTES = 16 << 20
_MOST_OVERVIEWS = 7
_MOST_BLOCKS = 256
"""For statistics: 67 megapixels, a second, and means good to a hundredth."""


@contextmanager
def block_cache(most_bytes: int) -> Iterator[None]:
    """GDAL's cache of blocks limited to a size; by itself it grows to a twentieth of the memory."""
    before = gdal.GetCacheMax()
    gdal.SetCacheMax(min(most_bytes, before))
    try:
        yield
    finally:
        gdal.SetCacheMax(before)


@dataclass(frozen=True)
class CogOptions:
    """How a COG is written. compression: one of COMPRESSIONS; quality: of LOSSY ones, in %; most_off: by how
    much values may change by LERC. overviews: one of OVERVIEWS. threads: that compress."""

    compression: str = COMPRESSION
    quality: int = 90
    most_off: float = 0.0
    overviews: str = OVERVIEWS_MADE
    threads: int = 2


def write_cog(
    raster: Path, out: Path, options: CogOptions = CogOptions(), progress: Progress | None = None
) -> bool:
    """Writes a raster, with its mask, as a COG with overviews and blocks of 512 px.

    One that composition wrote is a COG already: it gets a second name, or is copied where the file system has
    no hard links. Where it is to be kept otherwise, GDAL makes another one of it. Its metadata have the
    software, the ground pixel (`GSD_M`) and an RPC where the raster has one. They also have each band's
    statistics: the raster's own, or those of a sample of its blocks.
    Returns whether its bytes are the raster's. Raises: `InputError` if the compression can't hold these
    pixels; `OSError` if `out` can't be written.
    """
    callback = GdalProgress(progress)
    with callback.reraise(), gdal_failures(out), block_cache(_CACHE_BYTES):
        source = open_with_osgeo(raster, OWN)
        if (options.compression, options.overviews) == (COMPRESSION, OVERVIEWS_MADE) and _is_composed(source):
            del source
            try:
                os.link(raster, out)
            except OSError:
                _copy(raster, out, callback)
            return True
        creation = _creation_options(source, options)
        with gdal_options({"GDAL_PAM_ENABLED": "NO"}):
            if not source.GetRasterBand(1).GetMetadataItem("STATISTICS_MEAN"):
                _write_statistics(source)
        placed = source.GetGeoTransform(can_return_null=True)
        gsd = [f"GSD_M={placed[1]:.10g}"] if placed is not None else []
        done = gdal.Translate(
            str(out),
            source,
            format="COG",
            creationOptions=[*creation, f"NUM_THREADS={options.threads}"],
            metadataOptions=[f"TIFFTAG_SOFTWARE={SOFTWARE}", *gsd],
            callback=callback,
        )
        del done, source
        return False


def _is_composed(source: Any) -> bool:
    """Whether composition wrote a raster, as `mosaic.raster` does."""
    structure = source.GetMetadata("IMAGE_STRUCTURE")
    made = structure.get("LAYOUT") == "COG" and structure.get("COMPRESSION") == COMPRESSION.upper()
    return bool(made and source.GetMetadataItem("TIFFTAG_SOFTWARE") == SOFTWARE)


def _copy(raster: Path, out: Path, progress: GdalProgress) -> None:
    length, done = raster.stat().st_size, 0
    with raster.open("rb") as source, out.open("wb") as copy:
        while chunk := source.read(_COPIED_BYTES):
            copy.write(chunk)
            done += len(chunk)
            if not progress(done / length, "", None):
                return


def _creation_options(source: Any, cog: CogOptions) -> list[str]:
    """GDAL's creation options. Raises `InputError` if the compression can't hold these pixels."""
    compression, overviews = cog.compression, cog.overviews
    band = source.GetRasterBand(1)
    others = f"{', '.join(LOSSLESS)} or {LERC} with --set export.cog.compression=NAME"
    if compression in LOSSY and not (band.DataType == gdal.GDT_Byte and source.RasterCount in (1, 3)):
        kind = f"{source.RasterCount} bands of {gdal.GetDataTypeName(band.DataType)}"
        raise InputError(f"{compression} can't hold {kind}", fix=f"choose {others}")
    if compression == "webp" and source.RasterCount == 1:
        raise InputError("webp can't hold one band", fix=f"choose jpeg, {others}")
    options = [
        f"COMPRESS={compression.upper()}",
        f"BLOCKSIZE={_BLOCK_PX}",
        "BIGTIFF=IF_SAFER",
        f"OVERVIEW_RESAMPLING={overviews.upper()}",
        f"OVERVIEWS={'AUTO' if overviews == OVERVIEWS_MADE else 'IGNORE_EXISTING'}",
        *COMPRESSIONS[compression],
    ]
    if compression in LOSSY:
        options.append(f"QUALITY={cog.quality}")
    if compression == LERC:
        options.append(f"MAX_Z_ERROR={cog.most_off:g}")
    if max(source.RasterXSize, source.RasterYSize) > _BLOCK_PX << _MOST_OVERVIEWS:
        # GDAL holds as many rows at once as one of the smallest overview stands for.
        options.append(f"OVERVIEW_COUNT={_MOST_OVERVIEWS}")
    return options


def _write_statistics(source: Any) -> None:
    """Puts every band's statistics into its metadata, by valid pixels of evenly chosen blocks.

    GDAL's own count masked pixels as zeros.
    """
    wide, high = (-(-side // _BLOCK_PX) for side in (source.RasterXSize, source.RasterYSize))
    chosen = np.unique(np.linspace(0, wide * high - 1, min(wide * high, _MOST_BLOCKS)).astype(int))
    found = []
    for row, col in np.column_stack(np.divmod(chosen, wide)).tolist():
        left, top = col * _BLOCK_PX, row * _BLOCK_PX
        size = min(_BLOCK_PX, source.RasterXSize - left), min(_BLOCK_PX, source.RasterYSize - top)
        valid = source.GetRasterBand(1).GetMaskBand().ReadAsArray(left, top, *size) > 0
        if valid.any():
            pixels = source.ReadAsArray(left, top, *size).reshape(-1, *valid.shape)
            values = pixels[:, valid].astype(np.float64)
            by_band = values.sum(axis=1), (values**2).sum(axis=1)
            found.append((values.shape[1], values.min(axis=1), values.max(axis=1), *by_band))
    if not found:
        return
    count, least, most, sums, squares = (np.array(column) for column in zip(*found, strict=True))
    mean = sums.sum(axis=0) / count.sum()
    sd = np.sqrt(np.maximum(squares.sum(axis=0) / count.sum() - mean**2, 0.0))
    statistics = {"MINIMUM": least.min(axis=0), "MAXIMUM": most.max(axis=0), "MEAN": mean, "STDDEV": sd}
    for number in range(source.RasterCount):
        band = source.GetRasterBand(number + 1)
        for name, of_bands in statistics.items():
            band.SetMetadataItem(f"STATISTICS_{name}", f"{of_bands[number]:.10g}")
        if len(chosen) < wide * high:
            band.SetMetadataItem("STATISTICS_APPROXIMATE", "YES")
