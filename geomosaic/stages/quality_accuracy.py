"""accuracy.tif: standard deviations of the mosaic's pixels on the ground."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from geomosaic.composition.ownership import Ownership
from geomosaic.doors.scratch import scratch_folder
from geomosaic.export.accuracy import write_accuracy
from geomosaic.export.cog import CogOptions, write_cog
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.pipeline.function_stage import InputGroup, stage
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.accuracy_grid import (
    AccuracyBlock,
    AccuracyCells,
    MatchedCells,
    standing_m,
    tied_area,
)
from geomosaic.quality.ground_accuracy import HeightSource
from geomosaic.quality.ground_doubt import MATCHED
from geomosaic.stages.input_groups import AdjustedBlock
from geomosaic.surface.dtm import TERRAIN, TerrainModel
from geomosaic.surface.model import DenseSurface

ACCURACY = "accuracy.tif"


class AccuracyParams(StageParams):
    """See each parameter's help."""

    cell_px: int = param(16, help="side of a cell of the raster", unit="mosaic pixels", ge=1, le=4096)
    threads: int = param(2, help="threads that compress", ge=1, le=256, affects_output=False)


@dataclass(frozen=True)
class MatchedHeights(InputGroup):
    """The surface that was matched, and the bare ground below it, of a recipe that makes them."""

    surface: DenseSurface | None = None
    terrain: TerrainModel | None = None


@stage(
    "quality.accuracy", "Write the accuracy raster", group="Quality", version=3, outputs="accuracy_file",
    results=(ACCURACY,),
)  # fmt: skip
def quality_accuracy(
    block: AdjustedBlock,
    ownership: Ownership,
    heights: MatchedHeights,
    params: AccuracyParams,
    context: Context,
) -> RunFile:
    """Writes accuracy.tif on the mosaic's grid, coarser."""
    survey = block.survey
    cells = AccuracyCells(
        ownership,
        params.cell_px,
        survey.work_frame,
        block.adjusted,
        block.ground,
        tied_area(block.adjusted, block.ties, survey.work_frame, survey.map_crs),
        _matched(block.ground, heights),
    )

    def blocks() -> Iterator[AccuracyBlock]:
        for block in cells.blocks():
            context.check_cancelled()
            yield block

    with scratch_folder(context.work_folder) as scratch:
        plain = Path(scratch) / ACCURACY
        summary = write_accuracy(plain, cells.grid, blocks())
        with context.writing(ACCURACY) as path:
            write_cog(plain, path, CogOptions(overviews="nearest", threads=params.threads))
    for name, (median_m, most_m) in (
        ("horizontal", summary.horizontal_m),
        ("vertical", summary.vertical_m),
    ):
        stated = not is_local(survey.map_crs)  # else it is in no unit, and against no world
        context.metric(f"accuracy.{name}_median_m", _known(median_m) if stated else None)
        context.metric(f"accuracy.{name}_95_m", _known(most_m) if stated else None)
    for source in HeightSource:
        context.metric(f"accuracy.share.{source.name.lower()}", summary.shares[source])
    return context.run_file(ACCURACY)


def _matched(ground: GroundSurface, heights: MatchedHeights) -> MatchedCells | None:
    """Of the ground that the mosaic lies on, if that was matched."""
    kind, surface, terrain = ground.kind, heights.surface, heights.terrain
    if surface is None or kind not in MATCHED:
        return None
    matched = surface.views > 0
    if terrain is None:
        return MatchedCells(surface.cells, matched)
    if kind == TERRAIN:
        return MatchedCells(surface.cells, matched & terrain.seen)
    return MatchedCells(surface.cells, matched, standing_m(surface.up_m, terrain.up_m, matched))


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
