"""One scale of grey for all strips."""

from __future__ import annotations

import numpy as np

from geomosaic.ccd.model import StripOffsets
from geomosaic.ccd.radiometry import Radiometry, radiometry
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.stages.strip_input import opened_strips
from geomosaic.survey.strips import StripGeometry


class RadiometryParams(StageParams):
    """See each parameter's help."""

    balance: bool = param(True, help="bring the CCDs to one scale; off leaves every pixel's counts")


@stage("ccd.radiometry", "Greys of the strips", group="CCD strips", version=5, outputs="radiometry")
def ccd_radiometry(
    strips: StripGeometry, offsets: StripOffsets, params: RadiometryParams, context: Context
) -> Radiometry:
    """Gain and offset of each CCD, from what neighbours see alike."""
    found = Radiometry(np.ones(len(strips.ccds)), np.zeros(len(strips.ccds)))
    if params.balance:
        with opened_strips(strips) as opened:
            found = radiometry(opened, offsets, lambda done, total: context.progress(done, total, "greys"))
    context.metric("radiometry.gain", found.gain.round(6))
    context.metric("radiometry.offset", found.offset.round(4))
    names = ["" if ccd.path is None else ccd.path.name for ccd in strips.ccds]
    context.recorder.table("strips.greys", names, {"gain": found.gain, "offset": found.offset})
    return found
