"""How large the scene of strips will be, and what it will take, before the first offset is sought."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from geomosaic.composition.estimate import FilledPixels, estimate_scene
from geomosaic.errors import InputError
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context
from geomosaic.stages.exports_of_strips import export_map
from geomosaic.stages.mosaic_strips import mosaic_strips
from geomosaic.stages.reporting import in_recipe, params_of, report_estimate
from geomosaic.survey.strips import StripGeometry


def _plans(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How many strips and seams there are."""
    sizes = summary["metrics"]["strips"]
    size = f"{sizes['width_px']:,} px, up to {sizes['lines']:,} lines"
    missing = f", {sizes['missing']} missing" if sizes["missing"] else ""
    return [("strips", f"{sizes['ccds']} of {size}, {sizes['seams']} seams{missing}")]


@stage(
    "mosaic.estimate_strips", "Estimate the scene", group="Mosaic", version=1, cached=False, looks_ahead=True,
    plans=_plans,
)  # fmt: skip
def mosaic_estimate_strips(strips: StripGeometry, context: Context) -> None:
    """Refuses a scene that is too large (mosaic.strips' limit), that the disk has no room for, or whose map
    is asked for and that nothing lays there.

    It runs every time: the disk's room is of today.
    """
    width, height = strips.scene_width_px, strips.scene_lines
    on_map = in_recipe(context, export_map)
    if on_map and strips.model is None and strips.rpc is None:
        problem = "the scene can't be put on the map: the geometry file names neither a model nor an RPC"
        raise InputError(problem, fix="give 'model' or 'rpc' there, or leave out --map")
    sizes = {
        "ccds": len(strips.ccds),
        "width_px": strips.width_px,
        "lines": max(strips.lines),
        "seams": len(strips.pairs),
        "missing": strips.lines.count(0),
    }
    context.metric("strips", sizes)
    expected = estimate_scene(
        (width, height),
        FilledPixels(
            min(1.0, sum(strips.lines) * strips.width_px / (width * height)),
            1 if strips.bit_depth <= 8 else 2,
        ),
        params_of(context, mosaic_strips).max_gigapixels,
        on_map=on_map,
    )
    report_estimate(context, expected)
