"""How large the scene of strips will be, and what it will take, before the first offset is sought."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.mosaic.estimate import estimate_scene
from geomosaic.pipeline.stage import Context, Stage
from geomosaic.stages.mosaic_strips import MosaicStrips
from geomosaic.stages.reporting import params_of, report_estimate
from geomosaic.survey.strips import StripGeometry


class MosaicEstimateStrips(Stage):
    """Refuses a scene that is too large (mosaic.strips' limit), or that the disk has no room for.

    It runs every time: the disk's room is of today.
    """

    id = "mosaic.estimate_strips"
    display_name = "Estimate the scene"
    group = "Mosaic"
    version = 1
    cached = False
    looks_ahead = True
    inputs: ClassVar[dict[str, type]] = {"strips": StripGeometry}
    outputs: ClassVar[dict[str, type]] = {}

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """From the strips' sizes."""
        geometry: StripGeometry = inputs["strips"]
        width, height = geometry.scene_width_px, geometry.scene_lines
        expected = estimate_scene(
            width,
            height,
            filled_share=min(1.0, sum(geometry.lines) * geometry.width_px / (width * height)),
            pixel_bytes=1 if geometry.bit_depth <= 8 else 2,
            max_gigapixels=params_of(context, MosaicStrips).max_gigapixels,
        )
        report_estimate(context, expected)
        return {}
