"""colmap/: the adjusted block as COLMAP's text model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.adjustment.model import Adjusted
from geomosaic.export.colmap import write_colmap
from geomosaic.export.sfm import sfm_block
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.survey.model import Survey

FOLDER = "colmap"


class ExportColmap(Stage):
    """Writes colmap/: cameras.txt, images.txt and points3D.txt, in metres east, north and up."""

    id = "export.colmap"
    display_name = "Write the block for COLMAP"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey,
        "ties": TiePoints,
        "adjusted": Adjusted,
    }
    outputs: ClassVar[dict[str, type]] = {"colmap_folder": RunFile}
    results: ClassVar[tuple[str, ...]] = (FOLDER,)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Frames that are not rejected, and the points that their rays agree on."""
        survey: Survey = inputs["survey"]
        block = sfm_block(survey, inputs["ties"], inputs["adjusted"])
        at = survey.work_frame
        with context.writing(FOLDER) as folder:
            folder.mkdir()
            write_colmap(folder, block, (at.lon_deg, at.lat_deg, at.height_ellipsoidal_m))
        return {"colmap_folder": context.run_file(FOLDER)}
