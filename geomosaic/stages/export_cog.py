"""mosaic.tif: the mosaic as a cloud-optimised GeoTIFF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from geomosaic.doors.raster import OWN, open_raster
from geomosaic.errors import FileError
from geomosaic.export.cog import COMPRESSIONS, OVERVIEWS, CogOptions, write_cog
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.recording.file.thumbnail import thumbnail
from geomosaic.report.glance import Glance, glance

MOSAIC = "mosaic.tif"
_THUMBNAIL_PX = 1024


class CogParams(StageParams):
    """See each parameter's help."""

    compression: str = param(
        "deflate",
        help="deflate, zstd and lzw lose nothing, lerc no more than most_off; webp and jpeg are smaller",
        choices=COMPRESSIONS,
    )
    quality: int = param(90, help="of webp and jpeg", unit="%", ge=1, le=100)
    most_off: float = param(
        0.0, help="by how much lerc may change a value", unit="grey levels", ge=0.0, le=65535.0
    )
    overviews: str = param("average", help="how overviews are resampled", choices=OVERVIEWS)
    threads: int = param(2, help="threads that compress", ge=1, le=256, affects_output=False)


@stage(
    "export.cog", "Write the mosaic as COG", group="Export", version=4, outputs="mosaic_file",
    results=(MOSAIC,),
)  # fmt: skip
def export_cog(raster_file: RunFile, params: CogParams, context: Context) -> RunFile:
    """Writes mosaic.tif."""
    raster = _raster(raster_file, context)
    with context.writing(MOSAIC) as path:
        copied = write_cog(
            raster,
            path,
            CogOptions(
                compression=params.compression,
                quality=params.quality,
                most_off=params.most_off,
                overviews=params.overviews,
                threads=params.threads,
            ),
            progress=lambda done, total: context.progress(done, total, MOSAIC),
        )
    path = context.run_folder / MOSAIC
    small, on_map = _small(path)
    context.recorder.image("/images/mosaic", "mosaic", thumbnail(small))
    known = copied and raster == context.run_folder / raster_file.name
    file = context.copied_file(MOSAIC, raster_file) if known else context.run_file(MOSAIC)
    spare = context.optional_cache(Glance, str(path))
    if on_map and spare.path is not None:  # for the report, while others judge
        spare.leave(glance(path))
    return file


def _raster(composed: RunFile, context: Context) -> Path:
    """The composed raster; where RUN/work was deleted, the mosaic that was made of it."""
    try:
        return context.path_of(composed)
    except FileError:
        mosaic = context.run_folder / MOSAIC
        if not mosaic.is_file():
            raise
        return mosaic


def _small(path: Path) -> tuple[Any, bool]:
    """The mosaic at a fraction of its size, rows, cols, bands; and whether it lies on a map."""
    with open_raster(path, OWN) as tiff:
        reduction = max(1, max(tiff.width, tiff.height) // _THUMBNAIL_PX)
        shape = (min(tiff.count, 3), -(-tiff.height // reduction), -(-tiff.width // reduction))
        pixels = tiff.read(list(range(1, shape[0] + 1)), out_shape=shape)
        return np.moveaxis(pixels, 0, -1), tiff.crs is not None
