"""The mosaic by positions and attitudes alone, small, to be compared with the adjusted one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.pipeline.stage import Context, Stage, StageParams, param
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import GroundSurface
from geomosaic.report.given import GivenMosaic, given_image
from geomosaic.survey.model import Frame, Survey
from geomosaic.survey.small import Small, Spare


class MosaicGiven(Stage):
    """Composes reduced frames where they were reported to be; the report lays it beside the mosaic.

    Frames that matching found to be turned are righted. It takes nothing of the adjustment, so it is made
    while that goes on.
    """

    id = "mosaic.given"
    display_name = "Compose by positions alone"
    group = "Mosaic"
    version = 3
    beside: ClassVar[bool] = True
    wants_frames: ClassVar[bool] = True
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey, "prior_ground": GroundSurface, "placement": Placement,
    }  # fmt: skip
    outputs: ClassVar[dict[str, type]] = {"given": GivenMosaic}

    class Params(StageParams):
        """See each parameter's help."""

        longest_px: int = param(
            1000,
            help="longer side of the image that positions and attitudes alone would give, to be swiped over "
            "the mosaic in the report; 0: none",
            unit="px",
            ge=0,
            le=4000,
        )

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """On a grid of its own, which holds what the frames would see."""
        survey, ground, placement = (inputs[name] for name in self.inputs)
        if params.longest_px == 0:
            return {"given": GivenMosaic(None)}

        def spare(frame: Frame) -> Spare:
            return context.optional_cache(Small, frame.path)

        image = given_image(survey, placement, ground, params.longest_px, context.spooled, spare)
        return {"given": GivenMosaic(image)}
