"""Settles the mosaic's grid, and which frame gives which part of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.mosaic.alignment import read_alignment
from geomosaic.mosaic.area import elsewhere, read_outline
from geomosaic.mosaic.grid import MAX_GIGAPIXELS, far_from_own, output_grid, without_flung
from geomosaic.mosaic.hidden import Hidden
from geomosaic.mosaic.ownership import Ownership, cell_px_of, nearest_nadir, within
from geomosaic.mosaic.plugins import SEAMS_GROUP
from geomosaic.mosaic.scene import Scene
from geomosaic.mosaic.seam_cut import NEAREST_NADIR, SEAMS, Seam
from geomosaic.mosaic.seam_figures import seam_figures
from geomosaic.mosaic.seam_parts import Glimpse, bands, giving, glimpsed
from geomosaic.mosaic.shadows import hidden_parts, shaded, shadow, side_px_of
from geomosaic.mosaic.tones import Tones
from geomosaic.mosaic.views import frame_views
from geomosaic.pipeline.stage import Context, Stage, StageParams, param
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import GroundSurface
from geomosaic.stages.mosaic_grid import laid_extent, laid_pixel
from geomosaic.survey.model import Survey
from geomosaic.survey.small import Small

_SEEN = 0.98  # of an area; what is less isn't cells cut at its edge
_MENDED = "polygons that cross themselves were mended; is the mosaic's edge the one that was meant?"


class MosaicSeams(Stage):
    """Gives every part of the mosaic to a frame, with seams where frames show the ground alike."""

    id = "mosaic.seams"
    display_name = "Lay the seams"
    group = "Mosaic"
    version = 9
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey,
        "ground": GroundSurface,
        "placement": Placement,
        "adjusted": Adjusted,
    }
    optional_inputs: ClassVar[dict[str, type]] = {"tones": Tones}
    outputs: ClassVar[dict[str, type]] = {"ownership": Ownership}

    class Params(StageParams):
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
        max_gigapixels: float = param(
            MAX_GIGAPIXELS,
            help="largest mosaic; a larger one is refused before the frames are matched",
            unit="gigapixels",
            ge=0.001,
            le=1e6,
        )

    @classmethod
    def check(cls, params: Params) -> None:
        """The area's polygons, and the header of the raster to align to."""
        if params.aoi is not None:
            read_outline(params.aoi)
        if params.align_to is not None:
            alignment = read_alignment(params.align_to)
            if params.gsd_m != "auto":
                alignment.check_gsd(params.gsd_m)

    @classmethod
    def plugged(cls, params: Params) -> list[tuple[str, str]]:
        """The seam may be another distribution's."""
        return [(SEAMS_GROUP, params.seam)]

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Settles the grid by the adjusted frames, and who gives what of it."""
        survey: Survey = inputs["survey"]
        adjusted: Adjusted = inputs["adjusted"]
        ground, names = inputs["ground"], [f.name for f in survey.frames]
        used = [s != "rejected" for s in adjusted.status]
        views = frame_views(survey.work_frame, survey.map_crs, adjusted.poses, adjusted.cameras, used, ground)
        for i in sorted({i for i, use in enumerate(used) if use} - {v.frame for v in views}):
            context.warn("looks-past-ground", names[i], "its middle doesn't see the ground; left out")
        ground_pixel_m = inputs["placement"].ground_pixel_m
        if not any(survey.located):
            ground_pixel_m = float(np.median([v.gsd_m for v in views])) if views else np.nan
        gsd_m, origin_m = laid_pixel(params.gsd_m, params.align_to, survey.map_crs, ground_pixel_m)
        if meaning := far_from_own(gsd_m, ground_pixel_m):
            own = f"the frames' own is {ground_pixel_m:.3g} m"
            context.warn("gsd-far", "", f"the mosaic's pixel is {gsd_m:.3g} m, {own}: {meaning}")
        extent = laid_extent(params.aoi, survey.map_crs, views)
        if extent.outline is not None and extent.outline.mended:
            context.warn("aoi-mended", "", f"{extent.outline.file.name}: {_MENDED}")
        seeing, flung = without_flung(extent.views, gsd_m, params.max_gigapixels)
        for view in flung:
            used[view.frame] = False
            moved = adjusted.poses.positions_m[view.frame] - inputs["placement"].poses.positions_m[view.frame]
            away = f"{np.linalg.norm(moved) / 1000.0:,.1f} km from where its position says"
            context.warn("frame-flung", names[view.frame], f"the adjustment put it {away}; left out")
        grid = output_grid(survey.map_crs, seeing, gsd_m, names, params.max_gigapixels, origin_m)
        scene, hidden = self._shaded(Scene(survey.work_frame, ground, grid, seeing), context)
        ownership, nearest_m = nearest_nadir(scene, used, cell_px_of(scene))
        ownership = replace(ownership, hidden=hidden)
        if extent.area is not None and extent.outline is not None:
            ownership = within(ownership, extent.area)
            nearest_m[ownership.owner == 0] = -np.inf  # nothing is looked at there
            if not ownership.owner.any():
                raise elsewhere(extent.outline, survey.map_crs, views)
            seen = extent.area.seen(grid, ownership.owner > 0, ownership.cell_px)
            context.metric("seams.area_seen", seen)
            if seen < _SEEN:
                beyond = f"{100.0 * (1.0 - seen):.0f} % of the area lies beyond what the frames see"
                context.warn("aoi-beyond", "", f"{extent.outline.file.name}: {beyond}")
        if params.seam != NEAREST_NADIR:
            tones, cut = inputs.get("tones"), SEAMS[params.seam]
            ownership = self._cut(cut, params.seam, scene, ownership, nearest_m, survey, tones, context)
        return {"ownership": ownership}

    @staticmethod
    def _shaded(scene: Scene, context: Context) -> tuple[Scene, tuple[Hidden, ...]]:
        """What frames can't see of a ground on which things stand, and the scene whose views say it."""
        if not scene.ground.has_walls:
            return scene, ()
        side_px = side_px_of(scene)
        look = partial(shadow, replace(scene, views=()), side_px)
        shadows = context.map("shadows", look, scene.views, keys=[v.frame for v in scene.views])
        hidden, unseen = hidden_parts(scene.grid, side_px, shadows)
        context.metric("seams.unseen", asdict(unseen))
        return replace(scene, views=shaded(scene.views, hidden)), hidden

    @staticmethod
    def _cut(
        cut: Seam,
        name: str,
        scene: Scene,
        nearest: Ownership,
        nearest_m: np.ndarray[Any, Any],
        survey: Survey,
        tones: Tones | None,
        context: Context,
    ) -> Ownership:
        views = giving(scene, nearest)

        def glimpses() -> Iterator[Glimpse]:
            for band in bands(scene, nearest, nearest_m, views):
                finer = nearest.cell_px * scene.grid.gsd_m / band.view.gsd_m
                reduction = next((r for r in (8, 4, 2) if r <= finer), 1)
                frame = survey.frames[band.view.frame]
                yield Glimpse(frame, reduction, band, context.spared(Small, frame.path))

        look = partial(glimpsed, replace(scene, views=()), nearest.cell_px, tones)
        parts = context.map("seams", look, glimpses(), keys=[v.frame for v in views])
        ownership = cut(nearest, parts, context)
        for how, of in ((NEAREST_NADIR, nearest), (name, ownership)):
            context.metric(f"seams.{how}", asdict(seam_figures(of, parts)))
        return ownership
