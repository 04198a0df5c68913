"""The mosaic by positions and attitudes alone, small, to be compared with the adjusted one."""

from __future__ import annotations

from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import GroundSurface
from geomosaic.report.given import Decoding, GivenMosaic, given_image
from geomosaic.stages.spares import spare_of
from geomosaic.survey.model import Frame, Survey
from geomosaic.survey.small import Spare


class GivenParams(StageParams):
    """See each parameter's help."""

    longest_px: int = param(
        1000,
        help="longer side of the image that positions and attitudes alone would give, to be swiped over "
        "the mosaic in the report; 0: none",
        unit="px",
        ge=0,
        le=4000,
    )


@stage(
    "mosaic.given", "Compose by positions alone", group="Mosaic", version=4, outputs="given", concurrent=True,
    wants_frames=True,
)  # fmt: skip
def mosaic_given(
    survey: Survey, prior_ground: GroundSurface, placement: Placement, params: GivenParams, context: Context
) -> GivenMosaic:
    """Composes reduced frames where they were reported to be; the report shows it next to the mosaic.

    Frames that matching found to be turned are turned back. It takes nothing of the adjustment, so it is made
    while that goes on.
    """
    if params.longest_px == 0:
        return GivenMosaic(None)

    def spare(frame: Frame) -> Spare:
        return spare_of(context, frame.path)

    image = given_image(survey, placement, prior_ground, params.longest_px, Decoding(context.spooled, spare))
    return GivenMosaic(image)
