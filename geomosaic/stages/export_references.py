"""metashape.csv, pix4d.csv: adjusted positions and attitudes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from geomosaic.adjustment.model import Adjusted
from geomosaic.export.orientation import Orientations, orientations
from geomosaic.export.references import write_metashape, write_pix4d
from geomosaic.geodesy.mapcrs import check_on_earth
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.placement.model import Placement
from geomosaic.survey.model import Survey


class _ExportReferences(Stage):
    """A table of the frames that are not rejected."""

    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey,
        "placement": Placement,
        "adjusted": Adjusted,
    }
    write: ClassVar[staticmethod[[Path, Orientations], None]]

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """One file."""
        survey: Survey = inputs["survey"]
        check_on_earth(survey.map_crs, "list of positions")
        (table,), (output,) = self.results, self.outputs
        with context.writing(table) as path:
            self.write(path, orientations(survey, inputs["placement"].poses, inputs["adjusted"]))
        return {output: context.run_file(table)}


class ExportMetashape(_ExportReferences):
    """Writes metashape.csv, a camera reference: adjusted positions and yaw, pitch, roll in WGS 84."""

    id = "export.metashape"
    display_name = "Write positions for Metashape"
    outputs: ClassVar[dict[str, type]] = {"metashape_file": RunFile}
    results: ClassVar[tuple[str, ...]] = ("metashape.csv",)
    write = staticmethod(write_metashape)


class ExportPix4d(_ExportReferences):
    """Writes pix4d.csv, an image geolocation: adjusted positions in WGS 84 and omega, phi, kappa."""

    id = "export.pix4d"
    display_name = "Write positions for Pix4D"
    outputs: ClassVar[dict[str, type]] = {"pix4d_file": RunFile}
    results: ClassVar[tuple[str, ...]] = ("pix4d.csv",)
    write = staticmethod(write_pix4d)
