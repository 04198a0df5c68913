"""Files of a scene of CCD strips other than its mosaic: offsets, layers, the map, the report."""

from __future__ import annotations

from functools import partial
from typing import Literal

from geomosaic.camera.rpc import Rpc
from geomosaic.ccd.model import StripOffsets
from geomosaic.ccd.outlines import Outlines
from geomosaic.ccd.radiometry import Radiometry
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.export.offsets_csv import write_offsets_csv
from geomosaic.export.scene_map import (
    RESAMPLING,
    SceneMapOptions,
    check_rpc_there,
    ground_under,
    scene_rpc_of,
    write_scene_map,
)
from geomosaic.export.strip_layers import SceneOnMap, write_strip_layers
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.report.strips import StripsReport, render_strips_report
from geomosaic.stages.input_groups import JudgedScene
from geomosaic.stages.reporting import run_name
from geomosaic.survey.strips import StripGeometry

OFFSETS, LAYERS, MAP, REPORT = "offsets.csv", "layers.gpkg", "mosaic_map.tif", "report.html"


@stage(
    "export.offsets", "Write the strips' offsets", group="Export", version=1, outputs="offsets_file",
    results=(OFFSETS,),
)  # fmt: skip
def export_offsets(offsets: StripOffsets, context: Context) -> RunFile:
    """Writes the offsets of every line of every pair."""
    with context.writing(OFFSETS) as path:
        write_offsets_csv(path, offsets.pairs)
    return context.run_file(OFFSETS)


@stage(
    "export.strip_layers", "Write the strips' layers", group="Export", version=4, outputs="layers_file",
    results=(LAYERS,),
)  # fmt: skip
def export_strip_layers(
    scene: JudgedScene, outlines: Outlines, mosaic_file: RunFile, context: Context
) -> RunFile:
    """Writes where the scene, the strips and their seams lie."""
    with open_raster(context.path_of(mosaic_file), OWN) as mosaic:
        tags = mosaic.tags(ns="RPC")
    rpc = Rpc.from_metadata(tags) if tags else None
    with context.writing(LAYERS) as path:
        on_map = SceneOnMap(scene.strip_mosaic, outlines, rpc)
        write_strip_layers(path, scene.strips, on_map, scene.strip_quality)
    return context.run_file(LAYERS)


class MapParams(StageParams):
    """See each parameter's help."""

    crs: str = param("auto", help="the map's CRS; auto is the UTM zone of the scene's middle")
    gsd_m: float | Literal["auto"] = param(
        "auto", help="ground pixel; auto: the geometry's", unit="m", ge=0.01, le=1000.0
    )
    resampling: str = param("cubic", help="how the scene is resampled", choices=RESAMPLING)
    threads: int = param(2, help="threads at work", ge=1, le=64, affects_output=False)


@stage(
    "export.map",
    "Project the scene onto the map",
    group="Export",
    version=3,
    outputs="map_file",
    results=(MAP,),
)
def export_map(strips: StripGeometry, mosaic_file: RunFile, params: MapParams, context: Context) -> RunFile:
    """Writes mosaic_map.tif: the scene orthorectified by its RPC, on the geometry's DEM if it has one."""
    scene = context.path_of(mosaic_file)
    rpc = check_rpc_there(scene_rpc_of(scene), scene)
    ground = None if strips.dem is None else ground_under(strips.dem, scene, rpc)
    for warning in () if ground is None else ground.warnings:
        context.warn(warning.code, warning.frame, warning.text)
    with context.writing(MAP) as path:
        write_scene_map(
            scene,
            path,
            SceneMapOptions(
                strips.ground_pixel_m if params.gsd_m == "auto" else params.gsd_m,
                params.crs,
                params.resampling,
                params.threads,
            ),
            None if ground is None else ground.elevation,
            progress=partial(context.progress, text=MAP),
        )
    return context.run_file(MAP)


@stage(
    "export.strip_report", "Write the strips' report", group="Export", version=1, outputs="report_file",
    results=(REPORT,), cached=False,
)  # fmt: skip
def export_strip_report(
    scene: JudgedScene,
    offsets: StripOffsets,
    radiometry: Radiometry,
    mosaic_file: RunFile,
    context: Context,
) -> RunFile:
    """Runs every time, since it also reports what run.json holds so far."""
    page = render_strips_report(
        StripsReport(
            geometry=scene.strips,
            offsets=offsets,
            quality=scene.strip_quality,
            radiometry=radiometry,
            mosaic=scene.strip_mosaic,
            mosaic_file=context.path_of(mosaic_file),
            summary=context.summary(),
            name=run_name(context),
        )
    )
    with context.writing(REPORT) as path:
        path.write_text(page, encoding="utf-8")
    return context.run_file(REPORT)
