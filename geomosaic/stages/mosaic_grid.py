"""What the parameters of `mosaic.seams` say of the grid, for the stages that lay it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from geomosaic.composition.alignment import read_alignment
from geomosaic.composition.area import Area, Outline, area_seen, read_outline
from geomosaic.composition.grid import auto_gsd_m
from geomosaic.composition.limits import Limits, limits_of
from geomosaic.composition.model import MapPixels
from geomosaic.composition.views import FrameView, PosedFrames, frame_views
from geomosaic.projection.footprint import survey_pixel_m

TRIM: Final = "trim"
EDGES: Final = (TRIM, "keep")


@dataclass(frozen=True)
class Extent:
    """The frames that a mosaic is made of, of which only what lies in the area counts, and that area."""

    views: tuple[FrameView, ...]
    outline: Outline | None = None
    area: Area | None = None


def laid_extent(aoi: Path | None, crs: str, views: Sequence[FrameView]) -> Extent:
    """All the frames see, or what of it lies in the file's polygons. Raises: as `area_seen`."""
    if aoi is None or not views:
        return Extent(tuple(views))
    outline = read_outline(aoi)
    area, views = area_seen(outline, crs, views)
    return Extent(views, outline, area)


def laid_pixel(
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


class Seeing(PosedFrames):
    """Frames that may give pixels, and up to where they see well."""

    @property
    def pixel_m(self) -> float:
        """The frames' own ground pixel, see `survey_pixel_m`."""
        return survey_pixel_m(self.poses, self.cameras, self.used, self.ground)

    def views(self, limits: Limits | None = None) -> tuple[FrameView, ...]:
        """Of all that they see, or of what they see within limits."""
        return frame_views(self, self.survey.map_crs, limits)

    def limits(self, edges: str, pixel_m: float) -> Limits | None:
        """Up to where they see well, by the mosaic's pixel or the frames' own, the larger one; None where all
        is to be kept, or nothing is seen well."""
        if edges != TRIM or not np.isfinite(pixel_m):
            return None
        limits = limits_of(self.poses, self.cameras, self.used, self.ground, pixel_m)
        return limits if self.views(limits) else None
