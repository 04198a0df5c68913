"""odm/: adjusted positions and control points for OpenDroneMap."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.adjustment.model import Adjusted
from geomosaic.export.orientation import orientations
from geomosaic.export.references import write_odm_control, write_odm_geo
from geomosaic.geodesy.mapcrs import check_on_earth
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.placement.model import Placement
from geomosaic.survey.model import Survey

FOLDER = "odm"


class ExportOdm(Stage):
    """Writes odm/: geo.txt with the adjusted positions and attitudes, gcp_list.txt with the control points.

    Copy both beside the folder of images. Check points go to check_list.txt, which OpenDroneMap leaves alone.
    """

    id = "export.odm"
    display_name = "Write positions for OpenDroneMap"
    group = "Export"
    version = 2
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey,
        "placement": Placement,
        "adjusted": Adjusted,
    }
    outputs: ClassVar[dict[str, type]] = {"odm_folder": RunFile}
    results: ClassVar[tuple[str, ...]] = (FOLDER,)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Frames that are not rejected, points that were measured in images."""
        survey: Survey = inputs["survey"]
        check_on_earth(survey.map_crs, "list of positions")
        if any(" " in frame.name for frame in survey.frames):
            context.warn(
                "spaces-in-names", "", "OpenDroneMap parts columns by spaces, which frames' names have"
            )
        with context.writing(FOLDER) as folder:
            folder.mkdir()
            poses = orientations(survey, inputs["placement"].poses, inputs["adjusted"])
            write_odm_geo(folder / "geo.txt", poses)
            for name, check in (("gcp_list.txt", False), ("check_list.txt", True)):
                points = [point for point in survey.control if point.check is check]
                if any(point.images for point in points):
                    write_odm_control(folder / name, points, survey.map_crs)
        return {"odm_folder": context.run_file(FOLDER)}
