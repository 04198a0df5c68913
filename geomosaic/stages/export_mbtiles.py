"""mosaic.mbtiles: web map tiles in one file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.export.web import TILE_FORMATS, on_map, write_mbtiles
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param

MBTILES = "mosaic.mbtiles"


class ExportMbtiles(Stage):
    """Writes mosaic.mbtiles: web map tiles in one file."""

    id = "export.mbtiles"
    display_name = "Write MBTiles"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {"mosaic_file": RunFile}
    outputs: ClassVar[dict[str, type]] = {"mbtiles_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (MBTILES,)

    class Params(StageParams):
        """See each parameter's help."""

        format: str = param("png", help="of the tiles", choices=TILE_FORMATS)
        processes: int = param(2, help="processes at work", ge=1, le=64, affects_output=False)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """The tiles of export.tiles."""
        with context.writing(MBTILES) as path:
            write_mbtiles(
                on_map(context.path_of(inputs["mosaic_file"])),
                path,
                tile_format=params.format,
                processes=params.processes,
                check_cancelled=context.check_cancelled,
            )
        return {"mbtiles_file": context.run_file(MBTILES)}
