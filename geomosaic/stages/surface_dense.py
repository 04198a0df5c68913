"""The surface that frames show, instead of the smooth one through their tie points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.errors import InputError
from geomosaic.matching.features import grey
from geomosaic.pipeline.kept import Kept
from geomosaic.pipeline.stage import Context, Stage, StageParams, param
from geomosaic.projection.footprint import footprint, ground_sampling_distance_m
from geomosaic.projection.ground import GroundSurface, node_spacing_m
from geomosaic.surface.cells import Cells
from geomosaic.surface.doubts import doubts
from geomosaic.surface.fused import fused, unmatched
from geomosaic.surface.levels import Level, levels
from geomosaic.surface.model import DenseSurface
from geomosaic.surface.refinement import UNSEEN
from geomosaic.surface.tile import Heights, Picture, Search, matched, picture
from geomosaic.surface.verticals import Sighted
from geomosaic.survey.model import Frame, Survey
from geomosaic.survey.pixels import REDUCTIONS, read_pixels


class SurfaceDense(Stage):
    """Matches heights between the adjusted frames."""

    id = "surface.dense"
    display_name = "Match the surface"
    group = "Surface"
    version = 9
    wants_frames: ClassVar[bool] = True
    inputs: ClassVar[dict[str, type]] = {"survey": Survey, "adjusted": Adjusted, "ground": GroundSurface}
    outputs: ClassVar[dict[str, type]] = {"ground": GroundSurface, "surface": DenseSurface}

    class Params(StageParams):
        """See each parameter's help."""

        cell_px: float = param(4.0, help="side of a cell of the surface", unit="ground px", ge=2.0, le=64.0)

    @classmethod
    def conclusions(cls, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
        """How fine the surface is, and how much of it was seen."""
        told = summary["metrics"].get("surface", {})
        if "cell_m" not in told:
            return []
        return [
            ("surface", f"cells of {told['cell_m']:.3g} m, {100.0 * told['matched']:.0f} % of them matched")
        ]

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """From coarse cells to fine ones, tile by tile."""
        survey: Survey = inputs["survey"]
        adjusted: Adjusted = inputs["adjusted"]
        base: GroundSurface = inputs["ground"]
        used = [i for i, status in enumerate(adjusted.status) if status != "rejected"]
        gsd_m = {i: ground_sampling_distance_m(adjusted.poses[i], adjusted.cameras[i], base) for i in used}
        used = [i for i in used if np.isfinite(gsd_m[i])]
        outlines = [footprint(adjusted.poses[i], adjusted.cameras[i], base)[:, :2] for i in used]
        seen = np.vstack([np.zeros((0, 2)), *outlines])
        seen = seen[np.isfinite(seen).all(axis=1)]
        if not len(seen):
            raise InputError("no frame sees the ground", mend="run without --surface dense")
        low, high = seen.min(axis=0), seen.max(axis=0)
        wanted_m = params.cell_px * float(np.median([gsd_m[i] for i in used]))
        cell_m = node_spacing_m(low, high, wanted_m)
        if cell_m > wanted_m:
            text = f"cells of {cell_m:.3g} m instead of {wanted_m:.3g} m: as many as one surface may have"
            context.warn("surface-coarse", "", text)
        cols, rows = np.ceil((high - low) / cell_m).astype(int).tolist()
        cells = Cells(float(low[0]), float(low[1]), cell_m, rows, cols)
        if len(used) < 2:
            context.warn("surface-not-matched", "", "one frame shows no surface: it is as before")
            return {"ground": base, "surface": unmatched(cells, base)}
        places = adjusted.poses.positions_m[used]
        flying_m = float(np.median(places[:, 2] - base.up_at(places[:, 0], places[:, 1])))
        frames = [survey.frames[i] for i in used]
        found: list[Heights] = []
        for number, level in enumerate(levels(cells, flying_m)):
            looks = [(adjusted.poses[i], adjusted.cameras[i], _reduction(level, gsd_m[i])) for i in used]
            sighted = [Sighted(*look) for look in looks]
            above = found[-1].up_m if found else None
            found.append(_matched(context, f"level {number + 1}", level, base, sighted, frames, above))
        surface = fused(found[-1], cells, base)
        looked_at = found[-1].alike > UNSEEN
        for code, text in doubts(surface, found[-1], base, level):
            context.warn(code, "", text)
        context.metric("surface.cell_m", cell_m)
        context.metric("surface.matched", float((surface.views > 0).sum() / max(looked_at.sum(), 1)))
        return {"ground": surface.ground(), "surface": surface}


def _reduction(level: Level, gsd_m: float) -> int:
    """By how much a frame is reduced so that its pixels are about the level's."""
    return min(REDUCTIONS, key=lambda r: abs(np.log(r * gsd_m / level.pixel_m)))


@dataclass(frozen=True)
class _Tile:
    """What is looked for, how the frames that are asked look, and their pictures."""

    search: Search
    frames: tuple[Sighted, ...]
    pictures: tuple[Kept[Picture], ...]


def _matched(
    context: Context,
    name: str,
    level: Level,
    base: GroundSurface,
    sighted: list[Sighted],
    frames: list[Frame],
    above: Any,
) -> Heights:
    looks = [_Look(frame, int(s.reduction), s.turn_rad) for frame, s in zip(frames, sighted, strict=True)]
    pictures = context.stored(f"pictures of {name}", _picture, looks)
    tasks = level.tasks(sighted, base, above)
    items = (
        _Tile(t.search, tuple(sighted[k] for k in t.frames), tuple(pictures[k] for k in t.frames))
        for t in tasks
    )
    keys = [(t.tile.row, t.tile.col) for t in tasks]
    found = context.map(f"tiles of {name}", partial(_heights, base), items, keys=keys)
    for kept in pictures:
        kept.forget()
    return level.together(base, tasks, found)


@dataclass(frozen=True)
class _Look:
    """A frame, by how much its pixels are reduced, and how it is turned."""

    frame: Frame
    reduction: int
    turn_rad: float


def _picture(look: _Look) -> Picture:
    pixels, valid = read_pixels(look.frame, look.reduction, luma=True)
    return picture(grey(pixels, valid), valid, look.turn_rad)


def _heights(base: GroundSurface, tile: _Tile) -> Heights:
    return matched(tile.search, base, tile.frames, [p.look() for p in tile.pictures])
