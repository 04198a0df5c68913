"""What frames are projected onto: the surface with all that stands on the ground, or the ground below it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from geomosaic.composition.choice import agreement
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
        "as frames show it, nothing is torn; auto: the surface if frames differ clearly less on it",
        choices=(AUTO, *ORTHOS),
    )


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What frames are projected onto, and why."""
    ortho = summary["metrics"].get("ortho", {})
    ground = ortho.get("ground", ortho.get("laid_on"))  # the second key is of earlier versions
    if ground is None:
        return []
    found, why = ortho.get("disagreement"), ""
    if found is not None and all(found.get(name) is not None for name in ORTHOS):
        each = ", ".join(f"{found[name]:.2f} on the {name}" for name in ORTHOS)
        why = f": frames differ by {each}, at {ortho['places']} places"
    return [("ortho", f"projected onto the {ground}{why}")]


@stage(
    "mosaic.ground", "Choose the mosaic's ground", group="Mosaic", version=7, outputs="ground",
    conclusions=_conclusions,
)  # fmt: skip
def mosaic_ground(
    of: AdjustedSurvey, terrain: TerrainModel, params: OrthoParams, context: Context
) -> GroundSurface:
    """Chooses the ground of the mosaic, by what frames agree on."""
    survey, adjusted = of.survey, of.adjusted
    grounds = ortho_surface(of.ground), terrain.ground()
    chosen = params.ortho
    if chosen == AUTO:
        used = [s != "rejected" for s in adjusted.status]
        frames = PosedFrames(survey, adjusted.poses, adjusted.cameras, used, grounds[1])
        views = frame_views(frames, survey.map_crs)
        found = agreement(survey, views, grounds, context)
        chosen = ORTHOS[found.best]
        context.metric("ortho.disagreement", dict(zip(ORTHOS, found.disagreement, strict=True)))
        context.metric("ortho.squares", found.squares)
        context.metric("ortho.places", found.places)
    context.metric("ortho.ground", chosen)
    return grounds[ORTHOS.index(chosen)]
