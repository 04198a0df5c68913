"""How much of what the frames show is in the mosaic, and why the rest is not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely

from geomosaic.arrays import Floats
from geomosaic.composition.area import Area
from geomosaic.composition.model import TrimmedPart
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.views import PosedFrames
from geomosaic.constants import tuned
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.footprint import ground_from_image

_PLACES = tuned(12, "places", "along each side of a frame: fewer make the share coarse; more take time")


@dataclass(frozen=True)
class LeftOutLand:
    """The share of the land in the frames that trimming leaves out, and the reason for most of it; NaN with
    `--edges keep`."""

    share: float
    reason: str = ""


NOT_TRIMMED: Final = LeftOutLand(float("nan"))


def left_out_land(frames: PosedFrames, ownership: Ownership) -> LeftOutLand:
    """By places evenly over the frames, so that distant land counts by its pixels: up to the horizon it has
    most of the area. What lies outside an area that was asked for does not count.

    Args: frames: used: those that have a pose, whether they give pixels or not.
    """
    trimmed, grid, area = ownership.trimmed, ownership.grid, ownership.area
    if trimmed is None:
        return NOT_TRIMMED
    at_m = _places_m(frames, grid.crs)
    whole = shapely.box(grid.west_m, grid.south_m, grid.east_m, grid.north_m)
    kept = whole if area is None else area.geometry
    mapped = shapely.contains_xy(kept, at_m)
    counts = {part.reason: _count(part, at_m[~mapped]) for part in trimmed.parts}
    lost = sum(counts.values())
    if not lost:
        return LeftOutLand(0.0)
    return LeftOutLand(lost / (lost + int(mapped.sum())), max(counts, key=lambda reason: counts[reason]))


def _count(part: TrimmedPart, at_m: Floats) -> int:
    """How many places (k, 2) lie in it."""
    return int(shapely.contains_xy(Area(part.polygons).geometry, at_m).sum())


def _places_m(frames: PosedFrames, crs: str) -> Floats:
    """Easting and northing (k, 2) of what the frames' places show of the ground, m."""
    middles, found = (np.arange(_PLACES) + 0.5) / _PLACES, [np.zeros((0, 3))]
    share = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    for i, camera in enumerate(frames.cameras):
        if frames.used[i]:
            at_px = share * [camera.width_px, camera.height_px]
            found.append(ground_from_image(frames.poses[i], camera, frames.ground, at_px))
    points_m = np.concatenate(found)
    geodetic = frames.survey.work_frame.geodetic_from_enu(points_m[np.isfinite(points_m).all(axis=1)])
    return MapProjection(crs).map_from_geodetic(geodetic[:, 0], geodetic[:, 1])
