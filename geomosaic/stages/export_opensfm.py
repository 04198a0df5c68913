"""opensfm/: the adjusted block as an OpenSfM data set has it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.adjustment.model import Adjusted
from geomosaic.export.opensfm import write_opensfm
from geomosaic.export.sfm import sfm_block
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.survey.model import Survey

FOLDER = "opensfm"


class ExportOpensfm(Stage):
    """Writes opensfm/: reconstruction.json, tracks.csv, camera_models.json and reference_lla.json."""

    id = "export.opensfm"
    display_name = "Write the block for OpenSfM"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey,
        "ties": TiePoints,
        "adjusted": Adjusted,
    }
    outputs: ClassVar[dict[str, type]] = {"opensfm_folder": RunFile}
    results: ClassVar[tuple[str, ...]] = (FOLDER,)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Frames that are not rejected, and the points that their rays agree on."""
        survey: Survey = inputs["survey"]
        block = sfm_block(survey, inputs["ties"], inputs["adjusted"])
        at, times = survey.work_frame, tuple(survey.frames[i].time_s for i in block.frames)
        with context.writing(FOLDER) as folder:
            folder.mkdir()
            write_opensfm(folder, block, (at.lon_deg, at.lat_deg, at.height_ellipsoidal_m), times)
        return {"opensfm_folder": context.run_file(FOLDER)}
