"""pix4d.csv: adjusted positions and attitudes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.adjustment.model import Adjusted
from geomosaic.export.orientation import orientations
from geomosaic.export.references import write_pix4d
from geomosaic.geodesy.mapcrs import check_on_earth
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.placement.model import Placement
from geomosaic.survey.model import Survey

TABLE = "pix4d.csv"


class ExportPix4d(Stage):
    """Writes pix4d.csv, an image geolocation: adjusted positions in WGS 84 and omega, phi, kappa."""

    id = "export.pix4d"
    display_name = "Write positions for Pix4D"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey,
        "placement": Placement,
        "adjusted": Adjusted,
    }
    outputs: ClassVar[dict[str, type]] = {"pix4d_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (TABLE,)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Frames that are not rejected."""
        survey: Survey = inputs["survey"]
        check_on_earth(survey.map_crs, "list of positions")
        with context.writing(TABLE) as path:
            write_pix4d(path, orientations(survey, inputs["placement"].poses, inputs["adjusted"]))
        return {"pix4d_file": context.run_file(TABLE)}
