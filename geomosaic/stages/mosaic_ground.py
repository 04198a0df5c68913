"""What frames are projected onto: the surface with all that stands on the ground, or the ground below it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from geomosaic.composition.object_choice import agreement
from geomosaic.composition.objects import objects_between, standing_on, with_objects
from geomosaic.composition.ortho_surface import ortho_surface
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.projection.ground import GroundSurface
from geomosaic.stages.input_groups import AdjustedSurvey
from geomosaic.surface.dtm import TerrainModel

AUTO: Final = "auto"
ORTHOS: Final = ("surface", "terrain")


class OrthoParams(StageParams):
    """See each parameter's help."""

    ortho: str = param(
        AUTO,
        help="surface: roofs and crowns lie where they belong; terrain: what stands on the ground leans "
        "as frames show it, nothing is torn; auto: the surface for each object on which frames agree",
        choices=(AUTO, *ORTHOS),
    )


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What frames are projected onto, and why."""
    ortho = summary["metrics"].get("ortho", {})
    ground = ortho.get("ground", ortho.get("laid_on"))  # "laid_on": of earlier versions
    if ground is None:
        return []
    return [("ortho", f"projected onto the {ground}{ortho_why(ortho)}")]


def ortho_why(ortho: Mapping[str, Any]) -> str:
    """How many objects lie on the surface, and of their area; empty where they were not asked for."""
    if not ortho.get("objects"):
        return ""
    share = f"{100.0 * ortho['area_on_surface']:.0f} % of their area"
    return f": {ortho['objects_on_surface']} of {ortho['objects']} objects, {share}; the others lean"


@stage(
    "mosaic.ground", "Choose the mosaic's ground", group="Mosaic", version=5, outputs="ground",
    conclusions=_conclusions,
)  # fmt: skip
def mosaic_ground(
    of: AdjustedSurvey, terrain: TerrainModel, params: OrthoParams, context: Context
) -> GroundSurface:
    """Chooses the ground of the mosaic, object by object."""
    survey, adjusted, land = of.survey, of.adjusted, terrain.ground()
    context.metric("ortho.ground", "surface" if params.ortho == AUTO else params.ortho)
    if params.ortho != AUTO:
        return land if params.ortho == "terrain" else ortho_surface(of.ground)
    objects = objects_between(of.ground, land)
    used = [s != "rejected" for s in adjusted.status]
    frames = PosedFrames(survey, adjusted.poses, adjusted.cameras, used, land)
    views = frame_views(frames, survey.map_crs)
    raised = with_objects(of.ground, land, objects)
    chosen = agreement(survey, views, objects, (raised, land), context).chosen
    stands = objects.where(chosen)
    standing = int(np.count_nonzero(objects.labels))
    context.metric("ortho.objects", len(chosen))
    context.metric("ortho.objects_on_surface", int(chosen.sum()))
    context.metric("ortho.area_on_surface", float(stands.sum() / max(standing, 1)))
    return standing_on(land, raised, stands)
