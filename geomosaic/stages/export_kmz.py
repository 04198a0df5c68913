"""mosaic.kmz: the mosaic for Google Earth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.export.web import on_map, write_kmz
from geomosaic.pipeline.stage import Context, RunFile, Stage

KMZ = "mosaic.kmz"


class ExportKmz(Stage):
    """Writes mosaic.kmz for Google Earth and its like, finer as one comes nearer."""

    id = "export.kmz"
    display_name = "Write a KMZ"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {"mosaic_file": RunFile}
    outputs: ClassVar[dict[str, type]] = {"kmz_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (KMZ,)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """By GDAL's super-overlays."""
        with context.writing(KMZ) as path:
            write_kmz(
                on_map(context.path_of(inputs["mosaic_file"])),
                path,
                progress=lambda done, total: context.progress(done, total, KMZ),
            )
        return {"kmz_file": context.run_file(KMZ)}
