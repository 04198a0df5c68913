"""Heights of a run's surface at places of its map, and their deviations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.quality.measured import Figure
from geomosaic.quality.run_measures import RunRasters, sampled, scale_sd_of

ASSUMED: Final = (
    "a height has the deviation of accuracy.tif; in differences of heights the errors in common cancel, the "
    "deviations of surface_confidence.tif count as independent, and the scale's deviation is added"
)


@dataclass(frozen=True)
class MeasuredHeights:
    """Of places (n,), NaN where unknown: heights, their deviations, and those against the rest of the map."""

    up_m: Floats
    sd_m: Floats
    own_m: Floats


def measure_heights(rasters: RunRasters, at_m: Floats) -> MeasuredHeights | None:
    """Heights at places (n, 2) of the map; None of a run without a surface."""
    if rasters.surface is None or rasters.confidence is None:
        return None
    with (
        open_raster(rasters.surface, OWN) as surface,
        open_raster(rasters.confidence, OWN) as confidence,
        open_raster(rasters.accuracy, OWN) as accuracy,
    ):
        up_m, own_m = sampled(surface, 1, at_m), sampled(confidence, 1, at_m)
        vertical_sd_m = sampled(accuracy, 2, at_m)  # the band of vertical deviations, docs/outputs.md
        return MeasuredHeights(up_m, vertical_sd_m, own_m)


def height_difference(rasters: RunRasters, heights: MeasuredHeights) -> Figure:
    """The last height less the first one."""
    difference = float(heights.up_m[-1] - heights.up_m[0])
    by_scale = scale_sd_of(rasters.summary) * difference
    return Figure(difference, float(np.sqrt(heights.own_m[0] ** 2 + heights.own_m[-1] ** 2 + by_scale**2)))
