"""The surface that frames show, instead of the smooth one through their tie points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from geomosaic.composition.grid import stretching, without_flung
from geomosaic.composition.limits import limits_of
from geomosaic.composition.mosaic_scene import CandidateFrames
from geomosaic.composition.views import seen_part
from geomosaic.constants import tuned
from geomosaic.errors import InputError
from geomosaic.matching.features import grey
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.pipeline.stored_result import StoredResult
from geomosaic.projection.footprint import footprint, ground_sampling_distance_m
from geomosaic.projection.ground import GroundSurface
from geomosaic.stages.input_groups import AdjustedSurvey
from geomosaic.stages.reporting import first_capture_s
from geomosaic.stages.spares import spare_of
from geomosaic.surface.cells import Cells, Tile
from geomosaic.surface.consistency_filter import RIM_CELLS, FilteredTile, MatchCounts, consistent_heights
from geomosaic.surface.match_warnings import match_warnings
from geomosaic.surface.model import DenseSurface
from geomosaic.surface.plane_sweep import SweepView
from geomosaic.surface.pyramid import PyramidLevel, TileTask, cells_covering, pyramid_levels
from geomosaic.surface.tile_mosaic import mosaic_tiles, with_rim
from geomosaic.surface.tile_sgm import CensusImage, HeightSearch, TileHeights, census_image, match_tile
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.small import REDUCTIONS, Spare

_SHOWN_POINTS = tuned(40_000, "points", "of the surface in a recording: fewer hide roofs; more are megabytes")


class DenseParams(StageParams):
    """See each parameter's help."""

    cell_px: float = param(4.0, help="side of a cell of the surface", unit="ground px", ge=2.0, le=64.0)


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How fine the surface is, and how much of it was seen."""
    found = summary["metrics"].get("surface", {})
    if "cell_m" not in found:
        return []
    return [
        ("surface", f"cells of {found['cell_m']:.3g} m, {100.0 * found['matched']:.0f} % of them matched")
    ]


@stage(
    "surface.dense", "Match the surface", group="Surface", version=20, outputs=("ground", "surface"),
    wants_frames=True, conclusions=_conclusions,
)  # fmt: skip
def surface_dense(
    of: AdjustedSurvey, params: DenseParams, context: Context
) -> tuple[GroundSurface, DenseSurface]:
    """Matches heights between the adjusted frames."""
    survey, adjusted, base = of.survey, of.adjusted, of.ground
    kept = [status != "rejected" for status in adjusted.status]
    frames = CandidateFrames(survey, adjusted.poses, adjusted.cameras, kept, base)
    limits = limits_of(frames.poses, frames.cameras, kept, base, frames.pixel_m)
    views, _ = without_flung(frames.views(limits), frames.pixel_m)
    gsd_m = {v.frame: ground_sampling_distance_m(v.pose, v.camera, base) for v in views}
    views = tuple(v for v in views if np.isfinite(gsd_m[v.frame]))
    used = [v.frame for v in views]
    outlines = [
        footprint(v.pose, v.camera, base)[:, :2]
        if v.quality is None
        else seen_part(v.pose, v.camera, base, limits).points_m[:, :2]
        for v in views
    ]
    seen = np.vstack([np.zeros((0, 2)), *outlines])
    seen = seen[np.isfinite(seen).all(axis=1)]
    if not len(seen):
        raise InputError(
            "no frame sees the ground, so there is no dense surface", fix="run without --surface dense"
        )
    wanted_m = params.cell_px * float(np.median([gsd_m[i] for i in used]))
    cells = cells_covering(seen.min(axis=0), seen.max(axis=0), wanted_m)
    if cells.cell_m > wanted_m:
        name, fix = "", "to keep them, map parts of the flight by themselves"
        if far := stretching(views, wanted_m):
            name = survey.frames[far[0].frame].name
            fix = (
                f"without this frame, which lies far out, it would have {100.0 * far[1]:.2g} % of its size; "
                "correct its position with --pos, or take it out of the folder"
            )
        text = (
            f"cells of {cells.cell_m:.3g} m instead of {wanted_m:.3g} m: a surface may have no "
            f"more; smaller details are smoothed: {fix}"
        )
        context.warn("surface-coarse", name, text)
    context.metric("surface.cell_m", cells.cell_m)
    if len(used) < 2:
        context.warn(
            "surface-not-matched",
            "",
            "one frame alone gives no surface: the ground is used as without --surface dense; give frames "
            "that overlap",
        )
        surface = mosaic_tiles(cells, base, ())
        return surface.ground(), surface
    places = adjusted.poses.positions_m[used]
    flying_m = float(np.median(places[:, 2] - base.up_at(places[:, 0], places[:, 1])))
    both = pyramid_levels(cells, flying_m)
    sighted = [
        [SweepView(adjusted.poses[i], adjusted.cameras[i], _reduction(level, gsd_m[i])) for i in used]
        for level in both
    ]
    looks = [
        _LevelReductions(
            survey.frames[i],
            int(coarse.reduction),
            int(fine.reduction),
            fine.turn_rad,
            spare_of(context, survey.frames[i].path),
        )
        for i, coarse, fine in zip(used, *sighted, strict=True)
    ]
    stored = context.stored("pictures", _pictures, looks)
    surface, counted = _matched(context, both, base, sighted, stored)
    for pictures in stored:
        pictures.forget()
    for code, text in match_warnings(counted, both[-1], base.kind):
        context.warn(code, "", text)
    context.metric("surface.matched", counted.share)
    context.recorder.points("surface", surface.sampled_m(_SHOWN_POINTS), {}, first_capture_s(survey))
    return surface.ground(), surface


def _reduction(level: PyramidLevel, gsd_m: float) -> int:
    """By how much a frame is reduced so that its pixels are about the level's."""
    return min(REDUCTIONS, key=lambda r: abs(np.log(r * gsd_m / level.pixel_m)))


def _matched(
    context: Context,
    levels: Sequence[PyramidLevel],
    base: GroundSurface,
    sighted: Sequence[Sequence[SweepView]],
    pictures: Sequence[StoredResult[Pictures]],
) -> tuple[DenseSurface, MatchCounts]:
    """The surface by tiles of the coarse level, then of the fine one, then by what is kept of each fine tile
    given those around it. Each tile is made once, whichever process makes it, and lies on the disk until the
    surface is whole."""
    coarse, fine = levels
    of_coarse, of_fine = sighted

    def items(tasks: Sequence[TileTask], frames: Sequence[SweepView]) -> Iterator[_Tile]:
        for t in tasks:
            yield _Tile(t.search, tuple(frames[k] for k in t.frames), tuple(pictures[k] for k in t.frames))

    tasks = coarse.tasks(of_coarse, base, None)
    work, keys = partial(_heights, base), [(t.tile.row, t.tile.col) for t in tasks]
    found = context.map("coarse tiles", work, items(tasks, of_coarse), keys=keys)
    above = coarse.assembled(base, tasks, found)
    tasks = fine.tasks(of_fine, base, above)
    tiles, keys = [t.tile for t in tasks], [(t.tile.row, t.tile.col) for t in tasks]
    with context.spooled("fine tiles", work, items(tasks, of_fine), keys) as heights:
        near = (
            _Near(
                tile, tuple((o, h) for o, h in zip(tiles, heights, strict=True) if o.touches(tile, RIM_CELLS))
            )
            for tile in tiles
        )
        keeping = partial(_part, base, fine.cells, (fine.lowest_m, fine.highest_m))
        with context.spooled("tiles of the surface", keeping, near, keys) as parts:
            counted: list[MatchCounts] = []

            def loaded() -> Iterator[FilteredTile]:
                for part in parts:
                    found = part.load()
                    counted.append(found.counted)
                    yield found

            surface = mosaic_tiles(fine.cells, base, zip(tiles, loaded(), strict=True))
    return surface, sum(counted, MatchCounts())


@dataclass(frozen=True)
class _LevelReductions:
    """A frame, by how much its pixels are reduced for the coarse level and for the fine one, how it is
    turned, and where it may lie small."""

    frame: Frame
    coarse: int
    fine: int
    turn_rad: float
    spare: Spare | None


@dataclass(frozen=True)
class Pictures:
    """A frame as both levels look at it."""

    coarse: CensusImage
    fine: CensusImage


def _pictures(look: _LevelReductions) -> Pictures:
    pixels, valid = read_pixels(look.frame, look.fine, luma=True, spare=look.spare)
    shown = grey(pixels, valid)
    by = look.coarse // look.fine
    return Pictures(census_image(shown, valid, look.turn_rad, by), census_image(shown, valid, look.turn_rad))


@dataclass(frozen=True)
class _Tile:
    """What is looked for, how the frames that are asked look, and their pictures."""

    search: HeightSearch
    frames: tuple[SweepView, ...]
    pictures: tuple[StoredResult[Pictures], ...]


def _heights(base: GroundSurface, tile: _Tile) -> TileHeights:
    seen = [p.look() for p in tile.pictures]
    return match_tile(
        tile.search, base, tile.frames, [p.fine if tile.search.fine else p.coarse for p in seen]
    )


@dataclass(frozen=True)
class _Near:
    """A tile, and the heights of it and of those about it."""

    tile: Tile
    heights: tuple[tuple[Tile, StoredResult[TileHeights]], ...]


def _part(base: GroundSurface, cells: Cells, reach_m: tuple[float, float], near: _Near) -> FilteredTile:
    tile = near.tile
    found = with_rim(tile, cells, base, ((other, kept.look()) for other, kept in near.heights))
    return consistent_heights(found, tile.around(cells, RIM_CELLS), base, reach_m)
