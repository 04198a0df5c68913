"""One scale of grey for all strips."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from geomosaic.ccd.model import StripOffsets
from geomosaic.ccd.radiometry import Radiometry, radiometry
from geomosaic.pipeline.stage import Context, Stage, StageParams, param
from geomosaic.stages.strip_input import opened_strips
from geomosaic.survey.strips import StripGeometry


class CcdRadiometry(Stage):
    """Gain and offset of each CCD, from what neighbours see alike."""

    id = "ccd.radiometry"
    display_name = "Greys of the strips"
    group = "CCD strips"
    version = 3
    inputs: ClassVar[dict[str, type]] = {"strips": StripGeometry, "offsets": StripOffsets}
    outputs: ClassVar[dict[str, type]] = {"radiometry": Radiometry}

    class Params(StageParams):
        """See each parameter's help."""

        balance: bool = param(True, help="bring the CCDs to one scale; off leaves every pixel's counts")

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Gain 1 and offset 0 where it is switched off."""
        geometry: StripGeometry = inputs["strips"]
        found = Radiometry(np.ones(len(geometry.ccds)), np.zeros(len(geometry.ccds)))
        if params.balance:
            with opened_strips(geometry) as strips:
                found = radiometry(
                    strips, inputs["offsets"], lambda done, total: context.progress(done, total, "greys")
                )
        context.metric("radiometry.gain", found.gain.round(6))
        context.metric("radiometry.offset", found.offset.round(4))
        names = ["" if ccd.path is None else ccd.path.name for ccd in geometry.ccds]
        context.recorder.table("strips.greys", names, {"gain": found.gain, "offset": found.offset})
        return {"radiometry": found}
