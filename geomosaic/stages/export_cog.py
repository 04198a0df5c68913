"""mosaic.tif: the mosaic as a cloud-optimised GeoTIFF."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.export.cog import COMPRESSIONS, OVERVIEWS, write_cog
from geomosaic.mosaic.model import Mosaic
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param

MOSAIC = "mosaic.tif"


class ExportCog(Stage):
    """Writes mosaic.tif."""

    id = "export.cog"
    display_name = "Write the mosaic as COG"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {"mosaic": Mosaic, "raster_file": RunFile}
    outputs: ClassVar[dict[str, type]] = {"mosaic_file": RunFile}

    class Params(StageParams):
        """See each parameter's help."""

        compression: str = param(
            "deflate", help="deflate and zstd lose nothing; webp and jpeg are smaller", choices=COMPRESSIONS
        )
        quality: int = param(90, help="of webp and jpeg", unit="%", ge=1, le=100)
        overviews: str = param("average", help="how overviews are resampled", choices=OVERVIEWS)
        threads: int = param(2, help="threads that compress", ge=1, le=256, affects_output=False)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """From the raster in RUN/work."""
        raster = context.path_of(inputs["raster_file"])
        with context.writing(MOSAIC) as path:
            write_cog(
                raster,
                path,
                compression=params.compression,
                quality=params.quality,
                overviews=params.overviews,
                threads=params.threads,
                progress=lambda done, total: context.progress(done, total, MOSAIC),
            )
        return {"mosaic_file": context.run_file(MOSAIC)}
