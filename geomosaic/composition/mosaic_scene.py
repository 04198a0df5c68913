"""The scene that a mosaic is made of: which frames give pixels, on what grid, and where it ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final, Literal, Self

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Floats
from geomosaic.composition.alignment import read_alignment
from geomosaic.composition.area import Area, Outline, area_seen, elsewhere, read_outline
from geomosaic.composition.bands import with_all_bands
from geomosaic.composition.grid import auto_gsd_m, output_grid, without_flung
from geomosaic.composition.limits import Limits, limits_of
from geomosaic.composition.model import MapPixels, OutputGrid
from geomosaic.composition.ownership import Ownership, within
from geomosaic.composition.scene import Scene
from geomosaic.composition.trim import HORIZON, Edges, ViewingGeometry, mosaic_edges
from geomosaic.composition.untied import needless
from geomosaic.composition.views import FrameView, PosedFrames, frame_views
from geomosaic.constants import tuned
from geomosaic.projection.footprint import survey_pixel_m
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import Survey, Warn
from geomosaic.survey.names import some

TRIM: Final = "trim"
EDGES: Final = (TRIM, "keep")
_SEEN = tuned(0.98, "share", "of an area; less is not only cells cut at its edge")
_CORRECT = "correct its position with --pos, or take it out of the folder"
_CORRECTED = (
    "polygons that cross themselves were corrected: check the mosaic's edge, or correct them in a GIS"
)
WarningSink = Callable[[str, str, str], None]
"""Takes a warning: its code, the frame it is about or '', and its text."""


@dataclass(frozen=True)
class Extent:
    """The frames that a mosaic is made of, of which only what lies in the area counts, and that area."""

    views: tuple[FrameView, ...]
    outline: Outline | None = None
    area: Area | None = None

    def share_seen(self, ownership: Ownership) -> float:
        """How much of the area frames see well. Raises: as `elsewhere`."""
        assert self.area is not None
        assert self.outline is not None
        if not within(ownership, self.area).owner.any():
            raise elsewhere(self.outline, ownership.grid.crs, self.views)
        return self.area.seen(ownership.grid, ownership.owner > 0, ownership.cell_px)

    def unseen(self, share_seen: float, trimmed: bool) -> Iterator[Warn]:
        """A warning where much of the area is not seen. trimmed: whether edges are."""
        if share_seen < _SEEN:
            assert self.outline is not None
            beyond = f"{100.0 * (1.0 - share_seen):.0f} % of the area is not seen"
            beyond += " well by any frame and stays empty; " if trimmed else " by any frame and stays empty; "
            beyond += "--edges keep shows more" if trimmed else "fly it, or draw the area smaller"
            yield Warn("aoi-beyond", "", f"{self.outline.file.name}: {beyond}")


def extent_within(aoi: Path | None, crs: str, views: Sequence[FrameView]) -> Extent:
    """All the frames see, or what of it lies in the file's polygons. Raises: as `area_seen`."""
    if aoi is None or not views:
        return Extent(tuple(views))
    outline = read_outline(aoi)
    area, views = area_seen(outline, crs, views)
    return Extent(views, outline, area)


def mosaic_pixels(
    gsd_m: float | Literal["auto"], align_to: Path | None, crs: str, ground_pixel_m: float
) -> MapPixels:
    """The mosaic's pixels: those of the raster, or from the map's zero on.

    Raises: as `read_alignment`; `InputError` where the raster is in another CRS.
    """
    if align_to is not None:
        alignment = read_alignment(align_to)
        alignment.check_crs(crs)
        return MapPixels(crs, alignment.gsd_m, alignment.origin_m)
    return MapPixels(crs, auto_gsd_m(ground_pixel_m) if gsd_m == "auto" else gsd_m)


class CandidateFrames(PosedFrames):
    """Frames that may give pixels, and up to where they see well."""

    @classmethod
    def adjusted(cls, survey: Survey, adjusted: Adjusted, ground: GroundSurface) -> Self:
        """The frames that the adjustment did not reject, and of a rig those with all bands."""
        whole = zip(adjusted.status, with_all_bands(survey), strict=True)
        used = [status != "rejected" and complete for status, complete in whole]
        return cls(survey, adjusted.poses, adjusted.cameras, used, ground)

    @cached_property
    def pixel_m(self) -> float:
        """The frames' own ground pixel, see `survey_pixel_m`."""
        return survey_pixel_m(self.poses, self.cameras, self.used, self.ground)

    def views(self, limits: Limits | None = None) -> tuple[FrameView, ...]:
        """Of all that they see, or of what they see within limits."""
        if limits not in self._views:
            self._views[limits] = frame_views(self, self.survey.map_crs, limits)
        return self._views[limits]

    @cached_property
    def _views(self) -> dict[Limits | None, tuple[FrameView, ...]]:
        return {}

    def limits(self, edges: str, pixel_m: float) -> Limits | None:
        """Up to where they see well, by the mosaic's pixel or the frames' own, the larger one; None where all
        is to be kept, or nothing is seen well."""
        if edges != TRIM or not np.isfinite(pixel_m):
            return None
        limits = limits_of(self.poses, self.cameras, self.used, self.ground, pixel_m)
        return limits if self.views(limits) else None


@dataclass(frozen=True)
class MosaicScene:
    """The scene of a mosaic, and the frames that it leaves out.

    extent: what was asked for. area: what the mosaic is cut to. edges: where it ends. flung: frames left out
    for lying too far away. well: frames that see some of it well.
    """

    scene: Scene
    extent: Extent
    area: Area | None
    edges: Edges | None
    flung: frozenset[int]
    well: frozenset[int] = frozenset()

    def left_out(self, frames: CandidateFrames) -> Iterator[Warn]:
        """Warnings of the frames that give nothing, once each."""
        names = [f.name for f in frames.survey.frames]
        used = {i for i, use in enumerate(frames.used) if use}
        if self.edges is None:
            for i in sorted(used - {view.frame for view in frames.views()}):
                text = "its middle does not see the ground: left out of the mosaic"
                fix = "nothing to do if it shows the horizon, else correct its attitude with --pos"
                yield Warn("looks-past-ground", names[i], f"{text}; {fix}")
            return
        left = used - self.flung - {view.frame for view in self.scene.views}
        for code, text, their in (
            (
                "looks-aside",
                (
                    "too obliquely to be used: the mosaic takes other frames there, or ends; --edges "
                    "keep uses them"
                ),
                left - self.well,
            ),
            (
                "looks-beyond",
                "only at ground that is trimmed from the edges: not in the mosaic; --edges keep uses them",
                left & self.well,
            ),
        ):
            if their:
                number = f"{len(their)} frames look" if len(their) > 1 else "1 frame looks"
                of = some(names[i] for i in sorted(their))
                yield Warn(code, "", f"{number} {text} ({of})")


@dataclass(frozen=True)
class SceneChoice:
    """What a scene is chosen by.

    reported_m (n, 3): where the frames were reported. aoi: the file of the area that the mosaic is cut to.
    max_gigapixels: its largest size.
    """

    frames: CandidateFrames
    adjusted: Adjusted
    reported_m: Floats
    pixels: MapPixels
    aoi: Path | None
    max_gigapixels: float

    @property
    def _tied(self) -> list[bool]:
        return [status == "tied" for status in self.adjusted.status]

    def scene(self, limits: Limits | None, warn: WarningSink) -> MosaicScene:
        """The scene within limits, or of all that frames see where they see nothing within these."""
        choice = self if limits is None else self._without_needless(limits, warn)
        found = choice._within(limits, warn)
        if found is None:
            text = (
                "no frame sees the area steeply and finely enough: the mosaic shows what oblique or "
                "coarse views there are, which are distorted; fly it with the camera looking down"
            )
            warn("edges-kept", "", text)
            found = choice._within(None, warn)
            assert found is not None
        for warning in found.left_out(choice.frames):
            warn(warning.code, warning.frame, warning.text)
        if found.extent.outline is not None and found.extent.outline.corrected:
            warn("aoi-corrected", "", f"{found.extent.outline.file.name}: {_CORRECTED}")
        return found

    def _without_needless(self, limits: Limits, warn: WarningSink) -> SceneChoice:
        """Without frames that match no other and show what others show, or the horizon. All stay where none
        in use is tied."""
        frames = self.frames
        in_use = {i for i, use in enumerate(frames.used) if use}
        out = needless(frames.views(limits), self._tied, frames.ground, limits)
        if not out or out >= in_use or not any(self._tied[i] for i in in_use):
            return self
        number = f"{len(out)} frames match" if len(out) > 1 else "1 frame matches"
        names = some(frames.survey.frames[i].name for i in sorted(out))
        text = (
            f"{number} no other frame, and other frames show the same ground or it looks at the "
            f"horizon: left out of the mosaic ({names}); if ground is missing, --edges keep uses them"
        )
        warn("untied-left-out", "", text)
        used = [use and i not in out for i, use in enumerate(frames.used)]
        return replace(self, frames=replace(frames, used=used))

    def _within(self, limits: Limits | None, warn: WarningSink) -> MosaicScene | None:
        """The scene whose grid holds what is kept; None where nothing is seen within the limits."""
        frames, survey = self.frames, self.frames.survey
        extent = extent_within(self.aoi, survey.map_crs, frames.views())
        area, views, edges, well = extent.area, extent.views, None, frozenset[int]()
        if limits is not None:
            views = frames.views(limits)
            well = frozenset(view.frame for view in views)
            views = views if area is None else area.seen_by(views)
            if not views:
                return None
        views, far = without_flung(views, self.pixels.gsd_m, self.max_gigapixels)
        for view in far:
            moved_m = np.linalg.norm(frames.poses.positions_m[view.frame] - self.reported_m[view.frame])
            text = f"the adjustment placed it {moved_m / 1000.0:,.1f} km from where its position says"
            name = survey.frames[view.frame].name
            warn("frame-flung", name, f"{text}: left out of the mosaic; {_CORRECT}")
        flung = frozenset(view.frame for view in far)
        scene = Scene(survey.work_frame, frames.ground, self._grid(views), views)
        if limits is not None:
            seeing = tuple(view for view in frames.views(HORIZON) if view.frame not in flung)
            seeing = seeing if area is None else area.seen_by(seeing)
            looks = ViewingGeometry(frames.poses, seeing, limits, self.adjusted.ground, area)
            edges = mosaic_edges(scene, looks)
            if edges.kept.is_empty:
                return None
            if not edges.lost.is_empty:
                area, views = edges.area(area), edges.views(views, seeing)
                scene = replace(scene, grid=self._grid(views), views=views)
        return MosaicScene(scene, extent, area, edges, flung, well)

    def _grid(self, views: Sequence[FrameView]) -> OutputGrid:
        names = [f.name for f in self.frames.survey.frames]
        return output_grid(self.pixels, views, names, self.max_gigapixels)
