"""How large the scene of strips will be, and what it will take, before the first offset is sought."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.composition.estimate import FilledPixels, estimate_scene
from geomosaic.errors import InputError
from geomosaic.pipeline.stage import Context, Stage
from geomosaic.stages.exports_of_strips import export_map
from geomosaic.stages.mosaic_strips import MosaicStrips
from geomosaic.stages.reporting import in_recipe, params_of, report_estimate
from geomosaic.survey.strips import StripGeometry


class MosaicEstimateStrips(Stage):
    """Refuses a scene that is too large (mosaic.strips' limit), that the disk has no room for, or whose map
    is asked for and that nothing lays there.

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

    @classmethod
    def plans(cls, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
        """How many strips and seams there are."""
        told = summary["metrics"]["strips"]
        size = f"{told['width_px']:,} px, up to {told['lines']:,} lines"
        missing = f", {told['missing']} missing" if told["missing"] else ""
        return [("strips", f"{told['ccds']} of {size}, {told['seams']} seams{missing}")]

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """From the strips' sizes."""
        geometry: StripGeometry = inputs["strips"]
        width, height = geometry.scene_width_px, geometry.scene_lines
        laid = in_recipe(context, export_map)
        if laid and geometry.model is None and geometry.rpc is None:
            problem = "the scene can't be put on the map: the geometry file names neither a model nor an RPC"
            raise InputError(problem, fix="give 'model' or 'rpc' there, or leave out --map")
        told = {
            "ccds": len(geometry.ccds),
            "width_px": geometry.width_px,
            "lines": max(geometry.lines),
            "seams": len(geometry.pairs),
            "missing": geometry.lines.count(0),
        }
        context.metric("strips", told)
        expected = estimate_scene(
            (width, height),
            FilledPixels(
                min(1.0, sum(geometry.lines) * geometry.width_px / (width * height)),
                1 if geometry.bit_depth <= 8 else 2,
            ),
            params_of(context, MosaicStrips).max_gigapixels,
            on_map=laid,
        )
        report_estimate(context, expected)
        return {}
