"""surface.tif and what can be made of it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

from rasterio import Env

from geomosaic.composition.model import Mosaic
from geomosaic.doors.raster import OWN, READ_CACHE_BYTES, open_raster
from geomosaic.export.cog import block_cache, write_cog
from geomosaic.export.project_layers import CONTOURS
from geomosaic.export.project_rasters import HILLSHADE
from geomosaic.export.surface import RASTERS, SurfaceOnMap, surface_grid, writing_rasters
from geomosaic.export.surface_cloud import writing_cloud
from geomosaic.export.surface_drawn import write_contours, write_hillshade
from geomosaic.export.surface_heights import ELLIPSOIDAL, height_system, vertical_of, write_sidecar
from geomosaic.pipeline.memory_release import release_memory
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param
from geomosaic.surface.dtm import TerrainModel
from geomosaic.surface.model import DenseSurface
from geomosaic.survey.model import Survey

FILES = {name: f"{name}.tif" for name in RASTERS}
SIDECARS = ("surface.tif.aux.xml", "terrain.tif.aux.xml")
CLOUD = "point_cloud.laz"


class ExportSurface(Stage):
    """Writes surface.tif, surface_confidence.tif and terrain.tif, and more where it is asked for."""

    id = "export.surface"
    display_name = "Write the surface"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey, "surface": DenseSurface, "terrain": TerrainModel,
        "mosaic": Mosaic, "mosaic_file": RunFile,
    }  # fmt: skip
    outputs: ClassVar[dict[str, type]] = {
        "surface_file": RunFile, "confidence_file": RunFile, "terrain_file": RunFile,
    }  # fmt: skip
    results: ClassVar[tuple[str, ...]] = (*FILES.values(), *SIDECARS, HILLSHADE, CONTOURS, CLOUD)

    class Params(StageParams):
        """See each parameter's help."""

        heights: str = param(
            ELLIPSOIDAL, help="what heights count from: ellipsoidal, or a vertical CRS such as EPSG:5773"
        )
        hillshade: bool = param(False, help=f"write {HILLSHADE} as well")
        contours_m: float = param(
            0.0, help=f"from one contour of {CONTOURS} to the next, 0 for none", unit="m", ge=0.0, le=1000.0
        )
        point_cloud: bool = param(False, help=f"write {CLOUD} as well, coloured by the mosaic")
        threads: int = param(2, help="threads that compress", ge=1, le=256, affects_output=False)

    @classmethod
    def check(cls, params: Params) -> None:
        """The heights are those of a vertical CRS."""
        vertical_of(params.heights)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Block by block, then each raster as a COG."""
        survey: Survey = inputs["survey"]
        surface: DenseSurface = inputs["surface"]
        grid, by = surface_grid(inputs["mosaic"].grid, surface.cells.cell_m)
        heights = height_system(grid, params.heights)
        on_map = SurfaceOnMap(grid, by, survey.work_frame, surface, inputs["terrain"], heights)
        with TemporaryDirectory(dir=context.work_folder) as scratch:
            plain = {name: Path(scratch) / file for name, file in FILES.items()}
            with ExitStack() as stack:
                stack.enter_context(block_cache(READ_CACHE_BYTES))
                stack.enter_context(Env(GDAL_CACHEMAX=READ_CACHE_BYTES))
                mosaic = stack.enter_context(open_raster(context.path_of(inputs["mosaic_file"]), OWN))
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
                    write_cog(path, out, threads=params.threads)
        for file in SIDECARS:
            with context.writing(file) as out:
                write_sidecar(out, heights)
        context.metric("surface.heights", heights.text)
        context.metric("surface.pixel_m", grid.gsd_m)
        names = {f"{name.rpartition('_')[2]}_file": file for name, file in FILES.items()}
        return {name: context.run_file(file) for name, file in names.items()}
