"""The mosaic as a cloud-optimised GeoTIFF."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from osgeo import gdal

from geomosaic import __version__
from geomosaic.doors.raster import OWN, open_with_osgeo
from geomosaic.errors import InputError
from geomosaic.mosaic.gdal_failures import GdalProgress, Progress, gdal_failures

COMPRESSIONS: Final[dict[str, tuple[str, ...]]] = {
    "deflate": ("PREDICTOR=YES", "LEVEL=3"),
    "zstd": ("PREDICTOR=YES",),
    "webp": (),
    "jpeg": (),
}
"""Creation options that go with each compression; the last two lose a little and take 8 bits only."""
LOSSY: Final = ("webp", "jpeg")
OVERVIEWS: Final = ("average", "cubic", "bilinear", "lanczos", "nearest")
_BLOCK_PX = 512
_CACHE_BYTES = 256 << 20
_MOST_OVERVIEWS = 7


@contextmanager
def _block_cache(most_bytes: int) -> Iterator[None]:
    """GDAL's cache of blocks held to a size; by itself it grows to a twentieth of the memory."""
    before = gdal.GetCacheMax()
    gdal.SetCacheMax(min(most_bytes, before))
    try:
        yield
    finally:
        gdal.SetCacheMax(before)


def write_cog(
    raster: Path,
    out: Path,
    *,
    compression: str = "deflate",
    quality: int = 90,
    overviews: str = "average",
    threads: int = 2,
    progress: Progress | None = None,
) -> None:
    """Writes a raster, with its mask, as a COG with overviews and blocks of 512 px.

    The software and the ground pixel (`GSD_M`) stand in its metadata, and an RPC where the raster has one.
    Raises: `InputError` if the compression can't hold these pixels; `OSError` if `out` can't be written.
    """
    callback = GdalProgress(progress)
    with callback.reraise(), gdal_failures(out), _block_cache(_CACHE_BYTES):
        source = open_with_osgeo(raster, OWN)
        band = source.GetRasterBand(1)
        eight_bits = band.DataType == gdal.GDT_Byte
        if compression in LOSSY and not (eight_bits and source.RasterCount in (1, 3)):
            kind = f"{source.RasterCount} bands of {gdal.GetDataTypeName(band.DataType)}"
            raise InputError(
                f"{compression} can't hold {kind}", mend="choose deflate or zstd for export.cog.compression"
            )
        if compression == "webp" and source.RasterCount == 1:
            raise InputError("webp can't hold one band", mend="choose jpeg, deflate or zstd")
        options = [
            f"COMPRESS={compression.upper()}",
            f"BLOCKSIZE={_BLOCK_PX}",
            "BIGTIFF=IF_SAFER",
            f"OVERVIEW_RESAMPLING={overviews.upper()}",
            f"NUM_THREADS={threads}",
            *COMPRESSIONS[compression],
        ]
        if compression in LOSSY:
            options.append(f"QUALITY={quality}")
        if max(source.RasterXSize, source.RasterYSize) > _BLOCK_PX << _MOST_OVERVIEWS:
            # GDAL holds as many rows at once as one of the smallest overview stands for.
            options.append(f"OVERVIEW_COUNT={_MOST_OVERVIEWS}")
        placed = source.GetGeoTransform(can_return_null=True)
        gsd = [f"GSD_M={placed[1]:.10g}"] if placed is not None else []
        done = gdal.Translate(
            str(out),
            source,
            format="COG",
            creationOptions=options,
            metadataOptions=[f"TIFFTAG_SOFTWARE=geomosaic {__version__}", *gsd],
            callback=callback,
        )
        del done, band, source
