"""What the parameters of `mosaic.seams` say of the grid, for the stages that lay it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from geomosaic.mosaic.area import Area, Outline, area_seen, read_outline
from geomosaic.mosaic.views import FrameView


@dataclass(frozen=True)
class Extent:
    """The frames that a mosaic is made of, of which only what lies in the area counts, and that area."""

    views: tuple[FrameView, ...]
    outline: Outline | None = None
    area: Area | None = None


def extent(aoi: Path | None, crs: str, views: Sequence[FrameView]) -> Extent:
    """All the frames see, or what of it lies in the file's polygons. Raises: as `area_seen`."""
    if aoi is None or not views:
        return Extent(tuple(views))
    outline = read_outline(aoi)
    area, views = area_seen(outline, crs, views)
    return Extent(views, outline, area)
