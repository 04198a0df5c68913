"""The land below the surface that was matched."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.pipeline.stage import Context, Stage, StageParams, param
from geomosaic.surface.dtm import WIDEST_M, TerrainModel, terrain_model
from geomosaic.surface.model import DenseSurface


class SurfaceTerrain(Stage):
    """Takes houses and trees off the surface."""

    id = "surface.terrain"
    display_name = "Find the ground below the surface"
    group = "Surface"
    version = 1
    inputs: ClassVar[dict[str, type]] = {"surface": DenseSurface}
    outputs: ClassVar[dict[str, type]] = {"terrain": TerrainModel}

    class Params(StageParams):
        """See each parameter's help."""

        widest_m: float = param(
            WIDEST_M, help="width of houses and woods that are taken off", unit="m", ge=2.0, le=500.0
        )

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Filters the surface, and says how much of it was ground."""
        surface: DenseSurface = inputs["surface"]
        terrain = terrain_model(surface, params.widest_m)
        context.metric("surface.ground_share", terrain.share_of(surface))
        return {"terrain": terrain}
