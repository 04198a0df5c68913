"""layers.gpkg of a scene of strips."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.camera.rpc import Rpc
from geomosaic.ccd.outlines import Outlines
from geomosaic.composition.strip_compose import StripMosaic
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.export.strip_layers import write_strip_layers
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.quality.strips import StripQuality
from geomosaic.survey.strips import StripGeometry

LAYERS = "layers.gpkg"


class ExportStripLayers(Stage):
    """Writes where the scene, the strips and their seams lie."""

    id = "export.strip_layers"
    display_name = "Write the strips' layers"
    group = "Export"
    version = 2
    inputs: ClassVar[dict[str, type]] = {
        "strips": StripGeometry, "strip_mosaic": StripMosaic, "outlines": Outlines,
        "strip_quality": StripQuality, "mosaic_file": RunFile,
    }  # fmt: skip
    outputs: ClassVar[dict[str, type]] = {"layers_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (LAYERS,)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """By the RPC of mosaic.tif."""
        with open_raster(context.path_of(inputs["mosaic_file"]), OWN) as mosaic:
            tags = mosaic.tags(ns="RPC")
        with context.writing(LAYERS) as path:
            write_strip_layers(
                path,
                inputs["strips"],
                inputs["strip_mosaic"],
                inputs["outlines"],
                Rpc.from_metadata(tags) if tags else None,
                inputs["strip_quality"],
            )
        return {"layers_file": context.run_file(LAYERS)}
