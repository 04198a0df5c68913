"""Adjusted poses in, the mosaic out: every pixel resampled once."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

from geomosaic.composition.bands import compose_bands
from geomosaic.composition.blends import BLENDS
from geomosaic.composition.compose import (
    AUTO,
    AUTO_FEATHER_PX,
    CompositionOptions,
    TileKeeping,
    blend_of,
    compose,
)
from geomosaic.composition.composed_tiles import ComposedTiles, EarlierMosaic
from geomosaic.composition.model import Mosaic, OutputGrid
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.views import PosedFrames
from geomosaic.doors.scratch import scratch_folder
from geomosaic.matching.band_registration import RigPoses
from geomosaic.pipeline.artefact_reader import decode
from geomosaic.pipeline.artefacts import content_of, encode
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.projection.resample import RESAMPLING
from geomosaic.stages.input_groups import AdjustedSurvey, FrameShares, plugged_blend
from geomosaic.survey.model import Frame, Survey

RASTER = "work/mosaic.compose/mosaic.tif"
SOURCES = "sources.tif"
NOTES = "work/mosaic.compose/tiles.artefact"


class ComposeParams(StageParams):
    """See each parameter's help."""

    blend: str = param(
        AUTO,
        help="how frames pass into each other at seams; auto: multi_band for images of 8 bits, feather "
        "for measured values",
        choices=(AUTO, *BLENDS),
    )
    feather_m: float | Literal["auto"] = param(
        "auto",
        help=f"width of a feathered blend along seams and edges; auto: {AUTO_FEATHER_PX} ground pixels",
        unit="m",
        ge=0.0,
        le=1000.0,
    )
    resampling: str = param("cubic", help="how frames are resampled", choices=RESAMPLING)
    sources: bool = param(True, help=f"also write {SOURCES}: which frame made each pixel")
    threads: int = param(2, help="threads that write", ge=1, le=256, affects_output=False)


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What was reused of the run before."""
    its = summary["metrics"].get("reused")
    if its is None:
        return []
    parts = [
        f"{its[name]:,} of {its[f'{name}_of']:,} {what}"
        for name, what in (("frames", "frames' keypoints"), ("tiles", "tiles"))
        if name in its
    ]
    begun = ["the solution to begin from"] if its.get("adjustment") else []
    return [("reused", f"{', '.join(parts + begun)} of the run before")]


@stage(
    "mosaic.compose", "Compose the mosaic", group="Mosaic", version=23, outputs=("mosaic", "raster_file"),
    results=(SOURCES,), plugged=plugged_blend, conclusions=_conclusions, goes_on=True,
)  # fmt: skip
def mosaic_compose(
    of: AdjustedSurvey, shares: FrameShares, params: ComposeParams, context: Context
) -> tuple[Mosaic, RunFile]:
    """Warps the frames onto the map and blends them."""
    survey, ownership = of.survey, shares.ownership
    feather_m = None if params.feather_m == "auto" else params.feather_m

    rig = shares.rig or RigPoses()
    if feather_m is not None and (blends := _unfeathered(params.blend, survey, rig)):
        text = f"the blend {blends} has no width, so that its width in metres changes nothing"
        context.warn(
            "feather-unused", "", f"{text}: leave it out, or give --set mosaic.compose.blend=feather"
        )
    keeping = None if rig.bands or not params.sources else _keeping(survey, context)

    def composing(frames: PosedFrames, files: MosaicFiles) -> Mosaic:
        tones = shares.tones if frames.survey is survey else None
        options = CompositionOptions(
            *(params.blend, feather_m, params.resampling, tones, params.threads, keeping)
        )
        return compose(frames, ownership, files, options, context)

    if survey.other_bands and not rig.bands:
        text = (
            f"the mosaic shows only {survey.band} of the rig's bands, as this recipe aligns no others: make "
            "the run with geomosaic mosaic, or put the stage adjustment.rig into the recipe"
        )
        context.warn("bands-left-out", "", text)
    used = ownership.used.tolist()
    frames = PosedFrames(survey, of.adjusted.poses, of.adjusted.cameras, used, of.ground)
    with ExitStack() as stack:
        sources = stack.enter_context(context.writing(SOURCES)) if params.sources else None
        files = MosaicFiles(stack.enter_context(context.writing(RASTER)), sources)
        if rig.bands:
            folder = Path(stack.enter_context(scratch_folder(context.work_folder)))
            mosaic = compose_bands(composing, frames, rig, folder, files)
        else:
            mosaic = composing(frames, files)
    mosaic = replace(mosaic, raster=RASTER)
    _report(context, ownership.grid, mosaic)
    return mosaic, context.run_file(RASTER)


def _unfeathered(blend: str, survey: Survey, rig: RigPoses) -> str:
    """The blends of all bands, if none of them depends on a width; else ''."""
    bands = [survey.frames, *(band.frames for band in survey.other_bands if rig.bands)]
    dtypes = {frame.dtype for frames in bands for frame in frames if frame is not None}
    names = sorted({blend_of(blend, dtype) for dtype in dtypes})
    return "" if any(BLENDS[name].feathered for name in names) else " and ".join(names)


def _keeping(survey: Survey, context: Context) -> TileKeeping:
    """Tiles of the run before are kept where they would be the same; notes of all lie next to the raster."""
    frames = tuple(f"{frame.name} {_shown_by(frame, context)}" for frame in survey.frames)
    before = context.earlier

    def noted(tiles: ComposedTiles, kept: int) -> None:
        with context.writing(NOTES) as path:
            path.write_bytes(encode(tiles))
        if before is not None:
            context.metric("reused.tiles", kept)
            context.metric("reused.tiles_of", len(tiles.places))
            context.inform(f"{kept:,} of {len(tiles.places):,} tiles are from the run before")

    files = [] if before is None else [before.file("raster_file", name) for name in (RASTER, SOURCES, NOTES)]
    earlier = None
    if files and files[0] is not None and files[1] is not None and files[2] is not None:
        earlier = EarlierMosaic(files[0], files[1], decode(files[2].read_bytes(), ComposedTiles))
    return TileKeeping(frames, earlier, noted)


def _shown_by(frame: Frame, context: Context) -> str:
    """Names what a frame's pixels come from: its file, its mask, and how values become reflectance."""
    paths = [frame.path] if frame.valid_mask is None else [frame.path, frame.valid_mask]
    marks = [context.content_of(Path(path)) for path in paths]
    return " ".join(marks if frame.calibration is None else [*marks, content_of(frame.calibration)[0]])


def _report(context: Context, grid: OutputGrid, mosaic: Mosaic) -> None:
    size = {"width": grid.width_px, "height": grid.height_px}
    context.report("mosaic", {"crs": grid.crs, "gsd_m": grid.gsd_m, **size})
    context.metric("mosaic.frames_used", len(mosaic.frames_used))
    context.metric("mosaic.holes", asdict(mosaic.holes))
