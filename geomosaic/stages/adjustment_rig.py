"""How the cameras of a rig stand to one another; nothing to do for a single camera."""

from __future__ import annotations

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.matching.band_registration import Captures, RigPoses, register_bands
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.survey.model import Survey

_DOUBTFUL_PX = 1.0


class RigParams(StageParams):
    """See each parameter's help."""

    threads: int = param(2, help="threads at work", ge=1, le=256, affects_output=False)


@stage(
    "adjustment.rig", "Register a rig's bands", group="Adjustment", version=5, outputs="rig",
    wants_frames=True,
)  # fmt: skip
def adjustment_rig(survey: Survey, adjusted: Adjusted, params: RigParams, context: Context) -> RigPoses:
    """Finds each other band's turn against the frames' camera from all captures at once."""
    used = [status != "rejected" for status in adjusted.status]
    captures = Captures(survey, adjusted.poses, adjusted.cameras, used, adjusted.ground)
    rig = register_bands(captures, params.threads, context.progress)
    for band in rig.bands:
        figures = {"places": band.places, "before_px": band.before_px, "after_px": band.after_px}
        context.metric(f"bands.{band.name.replace('.', '_')}", figures)
        if not np.isfinite(band.after_px):
            text = (
                f"band {band.name}: too few matches to align it with the first band: placed by its "
                "tags, so its edges may show colour fringes; to map without the band, take its files out of "
                "the folder"
            )
            context.warn("band-not-registered", "", text)
        elif band.after_px > _DOUBTFUL_PX:
            text = (
                f"band {band.name}: still {band.after_px:.1f} px off the first band in the median: "
                "edges show colour fringes; a coarser --gsd hides them"
            )
            context.warn("band-doubtful", "", text)
    return rig
