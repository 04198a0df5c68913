"""mosaic.stac.json: a STAC item for catalogues."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.export.stac import ASSETS, stac_item, write_stac
from geomosaic.mosaic.model import Mosaic
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.survey.model import Survey

ITEM = "mosaic.stac.json"


class ExportStac(Stage):
    """Writes a STAC item whose assets are the run's files."""

    id = "export.stac"
    display_name = "Write a STAC item"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {"survey": Survey, "mosaic": Mosaic, "mosaic_file": RunFile}
    outputs: ClassVar[dict[str, type]] = {"stac_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (ITEM,)
    cached = False

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Names the files that are there by now."""
        survey: Survey = inputs["survey"]
        mosaic: Mosaic = inputs["mosaic"]
        times = [survey.frames[i].time_s for i in mosaic.frames_used]
        files = [name for name in ASSETS if (context.run_folder / name).is_file()]
        item = stac_item(context.run_folder.name, mosaic, [t for t in times if t is not None], files)
        with context.writing(ITEM) as path:
            write_stac(path, item)
        return {"stac_file": context.run_file(ITEM)}
