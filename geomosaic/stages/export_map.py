"""mosaic_map.tif: a scene of strips on the map."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from geomosaic.export.scene_map import (
    RESAMPLING,
    check_rpc_there,
    ground_under,
    scene_rpc_of,
    write_scene_map,
)
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param
from geomosaic.survey.strips import StripGeometry

MAP = "mosaic_map.tif"


class ExportMap(Stage):
    """Writes mosaic_map.tif: the scene orthorectified by its RPC, on the geometry's DEM if it has one."""

    id = "export.map"
    display_name = "Lay the scene on the map"
    group = "Export"
    version = 1
    inputs: ClassVar[dict[str, type]] = {"strips": StripGeometry, "mosaic_file": RunFile}
    outputs: ClassVar[dict[str, type]] = {"map_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (MAP,)

    class Params(StageParams):
        """See each parameter's help."""

        crs: str = param("auto", help="the map's CRS; auto is the UTM zone of the scene's middle")
        gsd_m: float | Literal["auto"] = param(
            "auto", help="ground pixel; auto: the geometry's", unit="m", ge=0.01, le=1000.0
        )
        resampling: str = param("cubic", help="how the scene is resampled", choices=RESAMPLING)
        threads: int = param(2, help="threads at work", ge=1, le=64, affects_output=False)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """By GDAL, with heights in the RPC's datum."""
        geometry: StripGeometry = inputs["strips"]
        scene = context.path_of(inputs["mosaic_file"])
        rpc = check_rpc_there(scene_rpc_of(scene), scene)
        ground = None if geometry.dem is None else ground_under(geometry.dem, scene, rpc)
        for warning in () if ground is None else ground.warnings:
            context.warn(warning.code, warning.frame, warning.text)
        with context.writing(MAP) as path:
            write_scene_map(
                scene,
                path,
                rpc,
                gsd_m=geometry.ground_pixel_m if params.gsd_m == "auto" else params.gsd_m,
                crs=params.crs,
                elevation=None if ground is None else ground.elevation,
                resampling=params.resampling,
                threads=params.threads,
                progress=lambda done, total: context.progress(done, total, MAP),
            )
        return {"map_file": context.run_file(MAP)}
