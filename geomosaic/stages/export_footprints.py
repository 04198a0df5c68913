"""footprints.geojson: footprints for web maps and scripts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.export.footprints import write_footprints
from geomosaic.pipeline.stage import Context, RunFile, Stage

FOOTPRINTS = "footprints.geojson"


class ExportFootprints(Stage):
    """Writes footprints.geojson: what each frame, or each CCD's strip, sees of the ground, in WGS 84."""

    id = "export.footprints"
    display_name = "Write footprints as GeoJSON"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {"layers_file": RunFile}
    outputs: ClassVar[dict[str, type]] = {"footprints_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (FOOTPRINTS,)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """From layers.gpkg."""
        with context.writing(FOOTPRINTS) as path:
            write_footprints(context.path_of(inputs["layers_file"]), path)
        return {"footprints_file": context.run_file(FOOTPRINTS)}
