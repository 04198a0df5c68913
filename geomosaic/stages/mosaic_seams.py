"""Chooses the mosaic's grid, and which frame gives which part of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from geomosaic.composition.alignment import read_alignment
from geomosaic.composition.area import read_outline
from geomosaic.composition.bands import narrowest
from geomosaic.composition.earlier_seams import with_earlier_seams
from geomosaic.composition.grid import MAX_GIGAPIXELS, far_from_own
from geomosaic.composition.mosaic_scene import (
    EDGES,
    TRIM,
    CandidateFrames,
    MosaicScene,
    SceneChoice,
    mosaic_pixels,
)
from geomosaic.composition.occlusion import occluded_scene
from geomosaic.composition.ownership import Ownership, cell_px_of, nearest_nadir, within
from geomosaic.composition.plugins import SEAMS_GROUP
from geomosaic.composition.seam_cut import NEAREST_NADIR, SEAMS
from geomosaic.composition.seam_figures import seam_figures
from geomosaic.composition.seam_parts import SeamPart, giving, glimpsed, glimpses
from geomosaic.composition.trim import filled
from geomosaic.composition.views import PosedFrames
from geomosaic.matching.band_registration import RigPoses
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.placement.model import Placement
from geomosaic.stages.earlier_frames import earlier_numbers
from geomosaic.stages.input_groups import AdjustedSurvey, BandTones
from geomosaic.stages.reporting import reported_trimmed, trimmed_text
from geomosaic.stages.spares import spare_of


class SeamParams(StageParams):
    """See each parameter's help."""

    gsd_m: float | Literal["auto"] = param(
        "auto",
        help="ground pixel; auto: the frames' median by POS, rounded by at most 5 %, the same for every "
        "method; where none has a position, that of the adjusted frames",
        unit="m",
        ge=0.0005,
        le=1000.0,
    )
    aoi: Path | None = param(
        None,
        help="area that the mosaic is cut to: a GeoPackage, GeoJSON, Shapefile, FlatGeobuf or KML of "
        "polygons, in any CRS",
    )
    align_to: Path | None = param(
        None,
        help="raster whose ground pixel and corner the mosaic takes over, so that their pixels coincide; "
        "survey.read.crs must be its CRS, as --align-to sees to",
    )
    seam: str = param(
        "least_difference",
        help="who gives a pixel where frames overlap: the one that looks down most steeply, or near the "
        "line between two of these, cut where both differ least in colour",
        choices=SEAMS,
    )
    edges: str = param(
        TRIM,
        help="trim: the mosaic ends where it is seen too far off the vertical or too coarsely, or where "
        "the ground is extrapolated too far; keep: all that frames see",
        choices=EDGES,
    )
    max_gigapixels: float = param(
        MAX_GIGAPIXELS,
        help="largest mosaic; a larger one is refused before the frames are matched",
        unit="gigapixels",
        ge=0.001,
        le=1e6,
    )


def _check(params: SeamParams) -> None:
    """The area's polygons, and the header of the raster to align to."""
    if params.aoi is not None:
        read_outline(params.aoi)
    if params.align_to is not None:
        alignment = read_alignment(params.align_to)
        if params.gsd_m != "auto":
            alignment.check_gsd(params.gsd_m)


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What was trimmed, and why."""
    trimmed = summary.get("trimmed")
    return [("edges", trimmed_text(trimmed))] if isinstance(trimmed, dict) and trimmed["parts"] else []


@stage(
    "mosaic.seams", "Place the seamlines", group="Mosaic", version=23, outputs="ownership",
    check=_check, plugged=lambda params: [(SEAMS_GROUP, params.seam)], conclusions=_conclusions,
    goes_on=True,
)  # fmt: skip
def mosaic_seams(
    of: AdjustedSurvey, placement: Placement, params: SeamParams, context: Context, shown: BandTones
) -> Ownership:
    """Gives every part of the mosaic to a frame, with seams where frames show the ground alike.

    Of cameras that take pictures at once the one that sees least decides.
    """
    tones = shown.tones
    if narrowed := _narrowed(of, shown.rig or RigPoses()):
        of, tones = narrowed, None
    chosen = _scene(of, placement, params, context, coarser=narrowed is not None)
    scene, hidden, unseen = occluded_scene(chosen.scene, context)
    if unseen is not None:
        context.metric("seams.unseen", asdict(unseen))
    used = np.isin(np.arange(len(of.survey.frames)), [v.frame for v in scene.views]).tolist()
    ownership, nearest_m = nearest_nadir(scene, used, cell_px_of(scene))
    ownership = replace(ownership, hidden=hidden)
    if chosen.edges is not None:
        ownership = filled(ownership, nearest_m, scene, chosen.edges.filling)
        ownership = replace(ownership, trimmed=chosen.edges.trimmed)
        context.report("trimmed", reported_trimmed(chosen.edges.trimmed, of.survey.map_crs))
    if chosen.extent.area is not None:
        seen = chosen.extent.share_seen(ownership)
        context.metric("seams.area_seen", seen)
        for warning in chosen.extent.unseen(seen, chosen.edges is not None):
            context.warn(warning.code, warning.frame, warning.text)
    if chosen.area is not None:
        ownership = within(ownership, chosen.area)
        nearest_m[ownership.owner == 0] = -np.inf  # nothing is looked at there
    if params.seam == NEAREST_NADIR:
        return ownership
    spare = partial(spare_of, context)
    jobs = glimpses(scene, ownership, nearest_m, of.survey.frames, spare)
    look = partial(glimpsed, replace(scene, views=()), ownership.cell_px, tones)
    parts = context.map("seams", look, jobs, keys=[v.frame for v in giving(scene, ownership)])
    cut = SEAMS[params.seam](ownership, parts, context)
    cut = _as_before(cut, parts, of, context)
    for how, result in ((NEAREST_NADIR, ownership), (params.seam, cut)):
        context.metric(f"seams.{how}", asdict(seam_figures(result, parts)))
    return cut


def _as_before(cut: Ownership, parts: Sequence[SeamPart], of: AdjustedSurvey, context: Context) -> Ownership:
    """With the seams of the run before, where it is gone on from and the frames are where they were."""
    was = None if context.earlier is None else context.earlier.artefact("ownership", Ownership)
    numbers = earlier_numbers(of.survey, of.adjusted, cut.grid.gsd_m, context)
    return cut if was is None else with_earlier_seams(cut, parts, was, numbers)


def _narrowed(of: AdjustedSurvey, rig: RigPoses) -> AdjustedSurvey | None:
    """The block as the band with the least view shows it; None where none has less than the frames."""
    adjusted = of.adjusted
    used = [status != "rejected" for status in adjusted.status]
    posed = PosedFrames(of.survey, adjusted.poses, adjusted.cameras, used, of.ground)
    band = narrowest(posed, rig)
    if band is None:
        return None
    seen = replace(adjusted, poses=band.poses, cameras=tuple(band.cameras))
    return replace(of, survey=band.survey, adjusted=seen)


def _scene(
    of: AdjustedSurvey, placement: Placement, params: SeamParams, context: Context, *, coarser: bool
) -> MosaicScene:
    """The scene by the adjusted frames, on the pixels that were asked for. coarser: than the frames' own are
    those of the band that decides."""
    frames = CandidateFrames.adjusted(of.survey, of.adjusted, of.ground)
    own_m = placement.ground_pixel_m if any(of.survey.located) else frames.pixel_m
    seen_m = max(own_m, frames.pixel_m) if coarser else own_m
    pixels = mosaic_pixels(params.gsd_m, params.align_to, of.survey.map_crs, own_m)
    before = None if context.earlier is None else context.earlier.artefact("ownership", Ownership)
    if before is not None and before.grid.crs == pixels.crs:
        pixels = replace(pixels, gsd_m=before.grid.gsd_m, earlier=before.grid)
    if text := far_from_own(pixels.gsd_m, own_m):
        context.warn("gsd-far", "", text)
    limits = frames.limits(params.edges, max(pixels.gsd_m, seen_m))
    scenes = SceneChoice(
        frames, of.adjusted, placement.poses.positions_m, pixels, params.aoi, params.max_gigapixels
    )
    return scenes.scene(limits, context.warn)
