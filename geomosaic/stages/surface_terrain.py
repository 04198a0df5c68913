"""The land below the surface that was matched."""

from __future__ import annotations

from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.surface.dtm import WIDEST_M, TerrainModel, terrain_model
from geomosaic.surface.model import DenseSurface


class TerrainParams(StageParams):
    """See each parameter's help."""

    widest_m: float = param(
        WIDEST_M, help="width of houses and woods that are taken off", unit="m", ge=2.0, le=500.0
    )


@stage("surface.terrain", "Find the ground below the surface", group="Surface", version=4, outputs="terrain")
def surface_terrain(surface: DenseSurface, params: TerrainParams, context: Context) -> TerrainModel:
    """Takes houses and trees off the surface."""
    terrain = terrain_model(surface, params.widest_m)
    context.metric("surface.ground_share", terrain.share_of(surface))
    if not terrain.seen.any() and surface.views.any():
        context.warn(
            "terrain-not-found",
            "",
            "no matched cell shows the ground, so the terrain model may contain houses and trees: use the "
            "surface instead, or make --set surface.terrain.widest_m smaller",
        )
    return terrain
