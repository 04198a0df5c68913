"""mosaic.mbtiles, mosaic.pmtiles: web map tiles in one file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.export.packed_tiles import write_packed
from geomosaic.export.tile_pyramid import FORMATS
from geomosaic.export.web import on_map
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param


class _ExportPackedTiles(Stage):
    """The tiles of export.tiles in one file."""

    group = "Export"
    version = 2
    inputs: ClassVar[dict[str, type]] = {"mosaic_file": RunFile}

    class Params(StageParams):
        """See each parameter's help."""

        format: str = param("png", help="of the tiles", choices=FORMATS)
        threads: int = param(2, help="threads at work", ge=1, le=64, affects_output=False)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """One file, named by its form."""
        (file,), (output,) = self.results, self.outputs
        with context.writing(file) as path:
            write_packed(
                on_map(context.path_of(inputs["mosaic_file"])),
                path,
                file.rpartition(".")[2],
                tile_format=params.format,
                threads=params.threads,
                progress=lambda done, total: context.progress(done, total, file),
            )
        return {output: context.run_file(file)}


class ExportMbtiles(_ExportPackedTiles):
    """Writes mosaic.mbtiles: web map tiles in one file, for phones and map servers."""

    id = "export.mbtiles"
    display_name = "Write MBTiles"
    outputs: ClassVar[dict[str, type]] = {"mbtiles_file": RunFile}
    results: ClassVar[tuple[str, ...]] = ("mosaic.mbtiles",)


class ExportPmtiles(_ExportPackedTiles):
    """Writes mosaic.pmtiles: web map tiles in one file, for web pages without a server of maps."""

    id = "export.pmtiles"
    display_name = "Write PMTiles"
    outputs: ClassVar[dict[str, type]] = {"pmtiles_file": RunFile}
    results: ClassVar[tuple[str, ...]] = ("mosaic.pmtiles",)
