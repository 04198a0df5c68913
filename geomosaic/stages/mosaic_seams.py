"""Settles the mosaic's grid, and which frame gives which part of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.composition.alignment import read_alignment
from geomosaic.composition.area import Area, elsewhere, read_outline
from geomosaic.composition.bands import with_all_bands
from geomosaic.composition.grid import MAX_GIGAPIXELS, far_from_own, output_grid, without_flung
from geomosaic.composition.hidden import Hidden
from geomosaic.composition.limits import Limits
from geomosaic.composition.model import MapPixels
from geomosaic.composition.occlusion import occluded_parts, occlusion_depth, side_px_of, with_occlusion
from geomosaic.composition.ownership import Ownership, cell_px_of, nearest_nadir, within
from geomosaic.composition.plugins import SEAMS_GROUP
from geomosaic.composition.scene import Scene
from geomosaic.composition.seam_cut import NEAREST_NADIR, SEAMS, Seam
from geomosaic.composition.seam_figures import seam_figures
from geomosaic.composition.seam_parts import Glimpse, bands, giving, glimpsed
from geomosaic.composition.tones import Tones
from geomosaic.composition.trim import HORIZON, Edges, ViewingGeometry, filled, mosaic_edges
from geomosaic.composition.untied import needless
from geomosaic.pipeline.stage import Context, Stage, StageParams, param
from geomosaic.placement.model import Placement
from geomosaic.projection.ground import GroundSurface
from geomosaic.stages.mosaic_grid import EDGES, TRIM, Extent, Seeing, laid_extent, laid_pixel
from geomosaic.stages.reporting import reported_trimmed, trimmed_text
from geomosaic.survey.model import Survey
from geomosaic.survey.small import Small

_SEEN = 0.98  # of an area; what is less isn't cells cut at its edge
_CORRECTED = (
    "polygons that cross themselves were corrected: check the mosaic's edge, or correct them in a GIS"
)


@dataclass(frozen=True)
class _Laid:
    """The scene that the mosaic is made of, what was asked for, the area that it is cut to, where it ends,
    the frames left out for lying too far away, and those that see some of it well."""

    scene: Scene
    extent: Extent
    area: Area | None
    edges: Edges | None
    flung: frozenset[int]
    well: frozenset[int] = frozenset()


class MosaicSeams(Stage):
    """Gives every part of the mosaic to a frame, with seams where frames show the ground alike."""

    id = "mosaic.seams"
    display_name = "Lay the seams"
    group = "Mosaic"
    version = 14
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

    @classmethod
    def conclusions(cls, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
        """What was trimmed, and why."""
        told = summary.get("trimmed")
        return [("edges", trimmed_text(told))] if isinstance(told, dict) and told["parts"] else []

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Settles the grid by the adjusted frames, and who gives what of it."""
        survey: Survey = inputs["survey"]
        adjusted: Adjusted = inputs["adjusted"]
        whole = zip(adjusted.status, with_all_bands(survey), strict=True)
        used = [status != "rejected" and complete for status, complete in whole]
        frames = Seeing(survey, adjusted.poses, adjusted.cameras, used, inputs["ground"])
        ground_pixel_m = inputs["placement"].ground_pixel_m
        if not any(survey.located):
            ground_pixel_m = frames.pixel_m
        pixels = laid_pixel(params.gsd_m, params.align_to, survey.map_crs, ground_pixel_m)
        if meaning := far_from_own(pixels.gsd_m, ground_pixel_m):
            own = f"the frames' own is {ground_pixel_m:.3g} m"
            context.warn("gsd-far", "", f"the mosaic's pixel is {pixels.gsd_m:.3g} m, {own}: {meaning}")
        limits = frames.limits(params.edges, max(pixels.gsd_m, ground_pixel_m))
        if limits is not None:
            frames = self._without_needless(frames, limits, adjusted, context)
        laid = self._laid(frames, limits, pixels, params, inputs, context)
        if laid is None:
            text = (
                "no frame sees the area steeply and finely enough: the mosaic shows what oblique or "
                "coarse views there are; expect distortion"
            )
            context.warn("edges-kept", "", text)
            laid = self._laid(frames, None, pixels, params, inputs, context)
            assert laid is not None
        self._tell_left_out(context, frames, laid)
        if laid.extent.outline is not None and laid.extent.outline.corrected:
            context.warn("aoi-mended", "", f"{laid.extent.outline.file.name}: {_CORRECTED}")
        used = np.isin(np.arange(len(used)), [v.frame for v in laid.scene.views]).tolist()
        scene, hidden = self._shaded(laid.scene, context)
        ownership, nearest_m = nearest_nadir(scene, used, cell_px_of(scene))
        ownership = replace(ownership, hidden=hidden)
        if laid.edges is not None:
            ownership = filled(ownership, nearest_m, scene, laid.edges.filling)
            ownership = replace(ownership, trimmed=laid.edges.trimmed)
            context.report("trimmed", reported_trimmed(laid.edges.trimmed))
        if laid.extent.area is not None:
            self._tell_of_area(context, laid.extent, survey.map_crs, ownership)
        if laid.area is not None:
            ownership = within(ownership, laid.area)
            nearest_m[ownership.owner == 0] = -np.inf  # nothing is looked at there
        if params.seam != NEAREST_NADIR:
            tones, cut = inputs.get("tones"), SEAMS[params.seam]
            ownership = self._cut(cut, params.seam, scene, ownership, nearest_m, survey, tones, context)
        return {"ownership": ownership}

    @staticmethod
    def _without_needless(frames: Seeing, limits: Limits, adjusted: Adjusted, context: Context) -> Seeing:
        """Without frames that match no other and show what others show, or the horizon; names them."""
        tied = [status == "tied" for status in adjusted.status]
        out = needless(frames.views(limits), tied, frames.ground, limits)
        if not out:
            return frames
        number = f"{len(out)} frames match" if len(out) > 1 else "1 frame matches"
        names = ", ".join(frames.survey.frames[i].name for i in sorted(out))
        text = (
            f"{number} no other frame, and other frames show the same ground or it looks at the "
            f"horizon: left out of the mosaic ({names})"
        )
        context.warn("untied-left-out", "", text)
        return replace(frames, used=[use and i not in out for i, use in enumerate(frames.used)])

    @staticmethod
    def _laid(
        frames: Seeing,
        limits: Limits | None,
        pixels: MapPixels,
        params: Params,
        inputs: Mapping[str, Any],
        context: Context,
    ) -> _Laid | None:
        """The scene whose grid holds what is kept; None where nothing is seen within the limits."""
        survey, names = frames.survey, [f.name for f in frames.survey.frames]
        gsd_m, crs = pixels.gsd_m, survey.map_crs
        extent = laid_extent(params.aoi, crs, frames.views())
        area, views, edges, well = extent.area, extent.views, None, frozenset[int]()
        if limits is not None:
            views = frames.views(limits)
            well = frozenset(view.frame for view in views)
            views = views if area is None else area.seen_by(views)
            if not views:
                return None
        views, flung = without_flung(views, gsd_m, params.max_gigapixels)
        for view in flung:
            moved = frames.poses.positions_m[view.frame] - inputs["placement"].poses.positions_m[view.frame]
            away = f"{np.linalg.norm(moved) / 1000.0:,.1f} km from where its position says"
            context.warn(
                "frame-flung",
                names[view.frame],
                f"the adjustment placed it {away}: left out of the mosaic; check its position",
            )
        grid = output_grid(pixels, views, names, params.max_gigapixels)
        scene = Scene(survey.work_frame, frames.ground, grid, views)
        if limits is not None:
            out = {view.frame for view in flung}
            seeing = tuple(view for view in frames.views(HORIZON) if view.frame not in out)
            seeing = seeing if area is None else area.seen_by(seeing)
            adjusted: Adjusted = inputs["adjusted"]
            tied = [status == "tied" for status in adjusted.status]
            looks = ViewingGeometry(frames.poses, tied, seeing, limits, adjusted.ground, area)
            edges = mosaic_edges(scene, looks)
            if edges.kept.is_empty:
                return None
            if not edges.lost.is_empty:
                area, views = edges.area(area), edges.views(views, seeing)
                grid = output_grid(pixels, views, names, params.max_gigapixels)
                scene = replace(scene, grid=grid, views=views)
        return _Laid(scene, extent, area, edges, frozenset(view.frame for view in flung), well)

    @staticmethod
    def _tell_left_out(context: Context, frames: Seeing, laid: _Laid) -> None:
        """Which frames give nothing, once."""
        names = [f.name for f in frames.survey.frames]
        gives = laid.flung | {view.frame for view in laid.scene.views}
        if laid.edges is None:
            seen = {view.frame for view in frames.views()}
            for i in sorted({i for i, use in enumerate(frames.used) if use} - seen):
                context.warn(
                    "looks-past-ground",
                    names[i],
                    "its middle does not see the ground: left out of the mosaic",
                )
            return
        left = [i for i, use in enumerate(frames.used) if use and i not in gives]
        for code, text, some in (
            (
                "looks-aside",
                (
                    "too obliquely to be used: the mosaic takes other frames there, or ends; --edges "
                    "keep uses them"
                ),
                set(left) - laid.well,
            ),
            (
                "looks-beyond",
                "only at ground that is trimmed from the edges: not in the mosaic; --edges keep uses them",
                laid.well.intersection(left),
            ),
        ):
            if some:
                number = f"{len(some)} frames look" if len(some) > 1 else "1 frame looks"
                context.warn(code, "", f"{number} {text} ({', '.join(names[i] for i in sorted(some))})")

    @staticmethod
    def _tell_of_area(context: Context, extent: Extent, crs: str, ownership: Ownership) -> None:
        """How much of the area that the mosaic is cut to is seen. Raises: as `elsewhere`."""
        assert extent.area is not None
        assert extent.outline is not None
        if not within(ownership, extent.area).owner.any():
            raise elsewhere(extent.outline, crs, extent.views)
        seen = extent.area.seen(ownership.grid, ownership.owner > 0, ownership.cell_px)
        context.metric("seams.area_seen", seen)
        if seen < _SEEN:
            beyond = (
                f"{100.0 * (1.0 - seen):.0f} % of the area is not seen well by any frame and stays "
                "empty; --edges keep shows more"
            )
            context.warn("aoi-beyond", "", f"{extent.outline.file.name}: {beyond}")

    @staticmethod
    def _shaded(scene: Scene, context: Context) -> tuple[Scene, tuple[Hidden, ...]]:
        """What frames can't see of a ground on which things stand, and the scene whose views say it."""
        if not scene.ground.has_walls:
            return scene, ()
        side_px = side_px_of(scene)
        look = partial(occlusion_depth, replace(scene, views=()), side_px)
        shadows = context.map("shadows", look, scene.views, keys=[v.frame for v in scene.views])
        hidden, unseen = occluded_parts(scene.grid, side_px, shadows)
        context.metric("seams.unseen", asdict(unseen))
        return replace(scene, views=with_occlusion(scene.views, hidden)), hidden

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
                yield Glimpse(frame, reduction, band, context.optional_cache(Small, frame.path))

        look = partial(glimpsed, replace(scene, views=()), nearest.cell_px, tones)
        parts = context.map("seams", look, glimpses(), keys=[v.frame for v in views])
        ownership = cut(nearest, parts, context)
        for how, of in ((NEAREST_NADIR, nearest), (name, ownership)):
            context.metric(f"seams.{how}", asdict(seam_figures(of, parts)))
        return ownership
