"""mosaic.vrt: a VRT beside the mosaic."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.export.web import write_vrt
from geomosaic.pipeline.stage import Context, RunFile, Stage

VRT = "mosaic.vrt"


class ExportVrt(Stage):
    """Writes mosaic.vrt, in which the mask is an alpha band."""

    id = "export.vrt"
    display_name = "Write a VRT"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {"mosaic_file": RunFile}
    outputs: ClassVar[dict[str, type]] = {"vrt_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (VRT,)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Refers to mosaic.tif by its name, so that both can be moved together."""
        with context.writing(VRT) as path:
            write_vrt(context.path_of(inputs["mosaic_file"]), path)
        return {"vrt_file": context.run_file(VRT)}
