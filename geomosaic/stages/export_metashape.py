"""metashape.csv: adjusted positions and attitudes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.adjustment.model import Adjusted
from geomosaic.export.orientation import orientations
from geomosaic.export.references import write_metashape
from geomosaic.geodesy.mapcrs import check_on_earth
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.placement.model import Placement
from geomosaic.survey.model import Survey

TABLE = "metashape.csv"


class ExportMetashape(Stage):
    """Writes metashape.csv, a camera reference: adjusted positions and yaw, pitch, roll in WGS 84."""

    id = "export.metashape"
    display_name = "Write positions for Metashape"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey,
        "placement": Placement,
        "adjusted": Adjusted,
    }
    outputs: ClassVar[dict[str, type]] = {"metashape_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (TABLE,)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Frames that are not rejected."""
        survey: Survey = inputs["survey"]
        check_on_earth(survey.map_crs, "list of positions")
        with context.writing(TABLE) as path:
            write_metashape(path, orientations(survey, inputs["placement"].poses, inputs["adjusted"]))
        return {"metashape_file": context.run_file(TABLE)}
