"""What frames are laid on: the surface with all that stands on the ground, or the ground below it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Final

from geomosaic.adjustment.model import Adjusted
from geomosaic.composition.choice import agreement
from geomosaic.composition.ortho_surface import ortho_surface
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.pipeline.stage import Context, Stage, StageParams, param
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.dtm import TerrainModel
from geomosaic.survey.model import Survey

AUTO: Final = "auto"
ORTHOS: Final = ("surface", "terrain")


class MosaicGround(Stage):
    """Chooses the ground of the mosaic, by what frames agree on."""

    id = "mosaic.ground"
    display_name = "Choose the mosaic's ground"
    group = "Mosaic"
    version = 4
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey,
        "adjusted": Adjusted,
        "ground": GroundSurface,
        "terrain": TerrainModel,
    }
    outputs: ClassVar[dict[str, type]] = {"ground": GroundSurface}

    class Params(StageParams):
        """See each parameter's help."""

        ortho: str = param(
            AUTO,
            help="surface: roofs and crowns lie where they belong; terrain: what stands on the ground leans "
            "as frames show it, nothing is torn; auto: the surface if frames differ clearly less on it",
            choices=(AUTO, *ORTHOS),
        )

    @classmethod
    def conclusions(cls, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
        """What the frames lie on, and why."""
        told = summary["metrics"].get("ortho", {})
        if "laid_on" not in told:
            return []
        found, why = told.get("disagreement"), ""
        if found is not None and all(found.get(name) is not None for name in ORTHOS):
            each = ", ".join(f"{found[name]:.2f} on the {name}" for name in ORTHOS)
            why = f": frames differ by {each}, at {told['places']} places"
        return [("ortho", f"laid on the {told['laid_on']}{why}")]

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Compares how frames show places where both grounds differ, if nobody has chosen."""
        survey: Survey = inputs["survey"]
        adjusted: Adjusted = inputs["adjusted"]
        grounds = ortho_surface(inputs["ground"]), inputs["terrain"].ground()
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
        context.metric("ortho.laid_on", chosen)
        return {"ground": grounds[ORTHOS.index(chosen)]}
