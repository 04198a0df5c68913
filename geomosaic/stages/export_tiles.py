"""tiles/: the mosaic as web map tiles, and a page that shows them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from geomosaic.export.tile_pyramid import FORMATS
from geomosaic.export.web import on_map, write_tiles
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param

TILES = "tiles"


class ExportTiles(Stage):
    """Writes tiles/index.html, a page without network, over tiles/{z}/{x}/{y} in Web Mercator."""

    id = "export.tiles"
    display_name = "Write web map tiles"
    group = "Export"
    version = 4
    inputs: ClassVar[dict[str, type]] = {"mosaic_file": RunFile}
    optional_inputs: ClassVar[dict[str, type]] = {"layers_file": RunFile}
    outputs: ClassVar[dict[str, type]] = {"tiles_folder": RunFile}
    results: ClassVar[tuple[str, ...]] = (TILES,)

    class Params(StageParams):
        """See each parameter's help."""

        format: str = param("png", help="of the tiles", choices=FORMATS)
        min_zoom: int | Literal["auto"] = param("auto", help="coarsest zoom", ge=0, le=30)
        max_zoom: int | Literal["auto"] = param("auto", help="finest zoom", ge=0, le=30)
        threads: int = param(2, help="threads at work", ge=1, le=64, affects_output=False)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Resampled once, then halved zoom by zoom."""
        with context.writing(TILES) as folder:
            write_tiles(
                on_map(context.path_of(inputs["mosaic_file"])),
                folder,
                tile_format=params.format,
                min_zoom=None if params.min_zoom == "auto" else params.min_zoom,
                max_zoom=None if params.max_zoom == "auto" else params.max_zoom,
                threads=params.threads,
                layers_file=context.path_of(inputs["layers_file"]) if "layers_file" in inputs else None,
                progress=lambda done, total: context.progress(done, total, TILES),
            )
        return {"tiles_folder": context.run_file(TILES)}
