"""surface.tif and what can be made of it."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from rasterio import Env

from geomosaic.doors.raster import OWN, READ_CACHE_BYTES, open_raster
from geomosaic.doors.scratch import scratch_folder
from geomosaic.export.cog import CogOptions, block_cache, write_cog
from geomosaic.export.project_layers import CONTOURS
from geomosaic.export.project_rasters import HILLSHADE
from geomosaic.export.surface import RASTERS, SurfaceOnMap, surface_grid, writing_rasters
from geomosaic.export.surface_cloud import writing_cloud
from geomosaic.export.surface_drawn import write_contours, write_hillshade
from geomosaic.export.surface_heights import height_system, write_sidecar
from geomosaic.geodesy.heights import ELLIPSOIDAL, height_datum_in_metres
from geomosaic.pipeline.function_stage import InputGroup, stage
from geomosaic.pipeline.memory_release import release_memory
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.stages.input_groups import FrameMosaic
from geomosaic.surface.dtm import TerrainModel
from geomosaic.surface.model import DenseSurface

FILES = {name: f"{name}.tif" for name in RASTERS}
SIDECARS = ("surface.tif.aux.xml", "terrain.tif.aux.xml")
CLOUD = "point_cloud.laz"


@dataclass(frozen=True)
class SurfaceModels(InputGroup):
    """The matched surface with all that stands on the ground, and the bare ground."""

    surface: DenseSurface
    terrain: TerrainModel


class SurfaceParams(StageParams):
    """See each parameter's help."""

    heights: str = param(
        ELLIPSOIDAL,
        help="what heights count from: ellipsoidal, EGM96, EGM2008, or a vertical CRS such as EPSG:7837",
    )
    hillshade: bool = param(False, help=f"write {HILLSHADE} as well")
    contours_m: float = param(
        0.0, help=f"from one contour of {CONTOURS} to the next, 0 for none", unit="m", ge=0.0, le=1000.0
    )
    point_cloud: bool = param(False, help=f"write {CLOUD} as well, coloured by the mosaic")
    threads: int = param(2, help="threads that compress", ge=1, le=256, affects_output=False)


def _check(params: SurfaceParams) -> None:
    """The heights are those of a vertical CRS."""
    height_datum_in_metres(params.heights)


@stage(
    "export.surface", "Write the surface", group="Export", version=2, outputs=("surface_file",
    "confidence_file", "terrain_file"), results=(*FILES.values(), *SIDECARS, HILLSHADE, CONTOURS, CLOUD),
    check=_check,
)  # fmt: skip
def export_surface(
    frames: FrameMosaic, models: SurfaceModels, mosaic_file: RunFile, params: SurfaceParams, context: Context
) -> tuple[RunFile, RunFile, RunFile]:
    """Writes surface.tif, surface_confidence.tif and terrain.tif, and more where it is asked for."""
    grid, by = surface_grid(frames.mosaic.grid, models.surface.cells.cell_m)
    heights = height_system(grid, params.heights)
    on_map = SurfaceOnMap(grid, by, frames.survey.work_frame, models.surface, models.terrain, heights)
    with scratch_folder(context.work_folder) as scratch:
        plain = {name: Path(scratch) / file for name, file in FILES.items()}
        with ExitStack() as stack:
            stack.enter_context(block_cache(READ_CACHE_BYTES))
            stack.enter_context(Env(GDAL_CACHEMAX=READ_CACHE_BYTES))
            mosaic = stack.enter_context(open_raster(context.path_of(mosaic_file), OWN))
            writers = [stack.enter_context(writing_rasters(plain, grid, heights))]
            if params.point_cloud:
                path = stack.enter_context(context.writing(CLOUD))
                writers.append(stack.enter_context(writing_cloud(path, grid, by, heights, mosaic)))
            for block in on_map.blocks(mosaic):
                context.check_cancelled()
                for write in writers:
                    write(block)
        if params.hillshade:
            plain["hillshade"] = Path(scratch) / HILLSHADE
            write_hillshade(plain["surface"], plain["hillshade"])
        if params.contours_m:
            with context.writing(CONTOURS) as out:
                write_contours(plain["terrain"], out, params.contours_m)
        for path in plain.values():
            release_memory()
            with context.writing(path.name) as out:
                write_cog(path, out, CogOptions(threads=params.threads))
    for file in SIDECARS:
        with context.writing(file) as out:
            write_sidecar(out, heights)
    context.metric("surface.heights", heights.text)
    context.metric("surface.pixel_m", grid.gsd_m)
    surface, confidence, terrain = (context.run_file(file) for file in FILES.values())
    return surface, confidence, terrain
