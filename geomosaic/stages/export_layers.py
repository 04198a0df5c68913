"""layers.gpkg and positions.csv."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.adjustment.model import Adjusted
from geomosaic.composition.model import Mosaic
from geomosaic.export.layers import write_layers
from geomosaic.export.orientation import orientations
from geomosaic.export.positions import write_positions
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.statement import answers, asprs_statement
from geomosaic.quality.verdict import Verdict
from geomosaic.survey.model import Survey

LAYERS = "layers.gpkg"
POSITIONS = "positions.csv"


class ExportLayers(Stage):
    """Writes where every frame, tie point and seam lies."""

    id = "export.layers"
    display_name = "Write layers and positions"
    group = "Export"
    version = 9
    beside: ClassVar[bool] = True
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey,
        "ground": GroundSurface,
        "placement": Placement,
        "ties": TiePoints,
        "adjusted": Adjusted,
        "mosaic": Mosaic,
    }
    optional_inputs: ClassVar[dict[str, type]] = {"verdict": Verdict}
    outputs: ClassVar[dict[str, type]] = {"layers_file": RunFile, "positions_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (POSITIONS, LAYERS)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Both files from the same adjusted poses."""
        survey, placement, adjusted = inputs["survey"], inputs["placement"], inputs["adjusted"]
        with context.writing(POSITIONS) as path:
            write_positions(
                path,
                orientations(survey, placement.poses, adjusted),
                [out.name for out in survey.left_out],
            )
        context.check_cancelled()
        with context.writing(LAYERS) as path:
            mosaic = inputs["mosaic"]
            stated = _stated(inputs["verdict"], mosaic.grid.gsd_m) if "verdict" in inputs else None
            write_layers(path, survey, placement, inputs["ties"], adjusted, mosaic, stated)
        return {"layers_file": context.run_file(LAYERS), "positions_file": context.run_file(POSITIONS)}


def _stated(verdict: Verdict, pixel_m: float) -> dict[str, str]:
    """Verdict, accuracy and the standard's sentence."""
    said = {"verdict": f"{verdict.grade}: {verdict.text}"}
    said |= dict(answers(verdict.accuracy, verdict.required, verdict.seams, pixel_m))
    said["ASPRS"] = asprs_statement(verdict.accuracy.absolute)
    return {name: text for name, text in said.items() if text}
