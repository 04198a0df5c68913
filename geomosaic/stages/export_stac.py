"""mosaic.stac.json: a STAC item for catalogues."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from geomosaic.ccd.outlines import Outlines
from geomosaic.composition.model import Mosaic
from geomosaic.composition.strip_compose import StripMosaic
from geomosaic.export.stac import (
    Coverage,
    coverage_of_mosaic,
    coverage_of_scene,
    stac_item,
    write_stac,
)
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.survey.model import Survey
from geomosaic.survey.strips import StripGeometry

ITEM = "mosaic.stac.json"


class ExportStac(Stage):
    """Writes mosaic.stac.json, a STAC item whose assets are the run's files."""

    id = "export.stac"
    display_name = "Write a STAC item"
    group = "Export"
    version = 3
    inputs: ClassVar[dict[str, type]] = {"mosaic_file": RunFile}
    optional_inputs: ClassVar[dict[str, type]] = {
        "survey": Survey,
        "mosaic": Mosaic,
        "strips": StripGeometry,
        "strip_mosaic": StripMosaic,
        "outlines": Outlines,
    }
    outputs: ClassVar[dict[str, type]] = {"stac_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (ITEM,)
    cached = False

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Names the files that are there by now."""
        times = [survey_time for survey_time in _times(inputs) if survey_time is not None]
        made_s = context.path_of(inputs["mosaic_file"]).stat().st_mtime
        item = stac_item(context.run_folder.name, _coverage(inputs), times, made_s, context.run_folder)
        with context.writing(ITEM) as path:
            write_stac(path, item)
        return {"stac_file": context.run_file(ITEM)}


def _times(inputs: Mapping[str, Any]) -> list[float | None]:
    """Of the frames that gave pixels."""
    if "mosaic" not in inputs:
        return []
    survey: Survey = inputs["survey"]
    return [survey.frames[i].time_s for i in inputs["mosaic"].frames_used]


def _coverage(inputs: Mapping[str, Any]) -> Coverage:
    if "mosaic" in inputs:
        return coverage_of_mosaic(inputs["mosaic"])
    scene, outlines = inputs["strip_mosaic"], inputs.get("outlines")
    ring = np.zeros((0, 2)) if outlines is None else outlines.scene
    return coverage_of_scene(ring, inputs["strips"].ground_pixel_m, scene.height_px, scene.width_px)
