"""Layers, positions, footprints and a project for geographic information systems."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2

from geomosaic.composition.model import Mosaic
from geomosaic.doors.scratch import scratch_folder
from geomosaic.export.cog import write_cog
from geomosaic.export.footprints import write_footprints
from geomosaic.export.index import AUTO, FORMULAS, Index, index_ends, write_index
from geomosaic.export.layers import SolvedSurvey, write_layers
from geomosaic.export.orientation import orientations
from geomosaic.export.positions import write_positions
from geomosaic.export.project import write_project
from geomosaic.export.project_layers import project_of
from geomosaic.export.project_rasters import index_colours, index_style
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.placement.model import Placement
from geomosaic.quality.statement import answers, asprs_statement
from geomosaic.quality.verdict import Verdict
from geomosaic.radiometry.quantity import TEMPERATURE, UNCALIBRATED
from geomosaic.report.surface import index_picture
from geomosaic.stages.input_groups import AdjustedBlock

LAYERS, POSITIONS = "layers.gpkg", "positions.csv"
FOOTPRINTS, PROJECT = "footprints.geojson", "project.qgz"
TITLE = "Mosaic"
"""Not the folder's name: equal runs give equal bytes wherever they lie."""


@stage(
    "export.layers", "Write layers and positions", group="Export", version=14,
    outputs=("layers_file", "positions_file"), results=(POSITIONS, LAYERS), concurrent=True,
)  # fmt: skip
def export_layers(
    block: AdjustedBlock,
    placement: Placement,
    mosaic: Mosaic,
    context: Context,
    verdict: Verdict | None = None,
) -> tuple[RunFile, RunFile]:
    """Writes where every frame, tie point and seam lies."""
    with context.writing(POSITIONS) as path:
        poses = orientations(block.survey, placement.poses, block.adjusted)
        write_positions(path, poses, [out.name for out in block.survey.left_out])
    context.check_cancelled()
    with context.writing(LAYERS) as path:
        stated = None if verdict is None else _stated(verdict, mosaic.grid.gsd_m)
        solved = SolvedSurvey(block.survey, placement, block.ties, block.adjusted, mosaic)
        write_layers(path, solved, stated)
    return context.run_file(LAYERS), context.run_file(POSITIONS)


def _stated(verdict: Verdict, pixel_m: float) -> dict[str, str]:
    """Verdict, accuracy and the standard's sentence."""
    said = {"verdict": f"{verdict.grade}: {verdict.text}"}
    said |= dict(answers(verdict.accuracy, verdict.required, verdict.seams, pixel_m))
    said["ASPRS"] = asprs_statement(verdict.accuracy.absolute)
    return {name: text for name, text in said.items() if text}


@stage(
    "export.footprints", "Write footprints as GeoJSON", group="Export", version=1, outputs="footprints_file",
    results=(FOOTPRINTS,),
)  # fmt: skip
def export_footprints(layers_file: RunFile, context: Context) -> RunFile:
    """Writes footprints.geojson: what each frame, or each CCD's strip, sees of the ground, in WGS 84."""
    with context.writing(FOOTPRINTS) as path:
        write_footprints(context.path_of(layers_file), path)
    return context.run_file(FOOTPRINTS)


class IndexParams(StageParams):
    """See each parameter's help."""

    formula: str = param(
        AUTO,
        help=f"{', '.join(FORMULAS)}, or a formula of band names such as (nir - red) / (nir + red); auto: "
        "NDVI, of a colour camera GLI; temperature: the thermal band",
    )
    name: str | None = param(None, help="of the files; the index's own, index for another formula")


def _check_index(params: IndexParams) -> None:
    """The formula is one."""
    if params.formula not in (AUTO, TEMPERATURE):
        Index.of(params.formula, params.name)


@stage(
    "export.index", "Write an index of bands", group="Export", version=2, outputs="index_file",
    check=_check_index,
)  # fmt: skip
def export_index(mosaic_file: RunFile, params: IndexParams, context: Context) -> RunFile:
    """Writes index_NAME.tif in 32-bit floats, index_NAME.png with a legend and index_NAME.qml, its style."""
    index = Index.for_mosaic(context.path_of(mosaic_file), params.formula, params.name)
    file = f"index_{index.name}"
    with scratch_folder(context.work_folder) as scratch:
        plain = Path(scratch) / "index.tif"
        progress = partial(context.progress, text=f"{file}.tif")
        values = write_index(context.path_of(mosaic_file), plain, index, progress)
        with context.writing(f"{file}.tif") as path:
            write_cog(plain, path)
        ends = index_ends(plain)
        picture, style = index_picture(plain, ends, index_colours(plain)), index_style(plain, ends)
    with context.writing(f"{file}.png") as path:
        cv2.imwrite(str(path), picture)
    with context.writing(f"{file}.qml") as path:
        path.write_text(style, encoding="utf-8")
    if UNCALIBRATED.name in values:
        warned = {warning["code"] for warning in context.summary().get("warnings", ())}
        limit = "compare it within this map only, or"
        if "exposure-varies" in warned:
            limit = "it differs from frame to frame as exposures do;"
        text = f"{index.name} is of {values}: {limit} calibrate the frames with --radiometry reflectance"
        context.warn("index-uncalibrated", "", text)
    context.metric(f"index.{index.name}", {"formula": index.formula, "values": values})
    return context.run_file(f"{file}.tif")


@stage(
    "export.project", "Write a QGIS project", group="Export", version=2, outputs="project_file",
    results=(PROJECT,), cached=False,
)  # fmt: skip
def export_project(layers_file: RunFile, mosaic_file: RunFile, context: Context) -> RunFile:
    """Writes project.qgz: the mosaic, the surface where there is one, and all layers, in groups and styled.

    Paths in it are relative: the run's folder can be moved.
    """
    crs, extent, groups = project_of(context.path_of(layers_file), context.path_of(mosaic_file))
    with context.writing(PROJECT) as path:
        write_project(path, TITLE, crs, extent, groups)
    return context.run_file(PROJECT)
