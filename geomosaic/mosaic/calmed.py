"""A matched surface without what would tear the picture: smooth where it isn't sure, edges left alone."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import sourced, tuned
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.terrain import filled

Bools = NDArray[np.bool_]
Floats32 = NDArray[np.float32]
_UNSURE_NODES = sourced(
    8.0,
    "distances between nodes",
    "of deviation from which on a height counts as unsure: neighbours that far apart fold the picture; "
    "with less, roofs go, with more, crowns that wind moves stay torn",
    "computed of a simulated town: with 8 the surface stays as true as it is, with 6 of the cells at "
    "walls 23.9 % instead of 23.1 % are off by more than 1 m, with 4 34.7 %; a real wood isn't torn with "
    "any",
)
_WIDE_M = tuned(
    2.5,
    "m",
    "across which land must be unsure to be smoothed, at least: single crowns are wider",
)
_WIDE_NODES = sourced(
    12.0,
    "distances between nodes",
    "across which it must be, at least: about walls deviations are large over some nodes, and roofs are "
    "to keep their edges",
    "computed of the same town, with 6 nodes of deviation: with 6 across 30.1 % at walls are off, with "
    "12 23.9 %",
)
_CALM_M = tuned(
    4.0,
    "m",
    "deviation of the Gaussian that smooths: with less, slopes between crowns still stretch what frames "
    "show, with more, woods lean as on the terrain",
)
_APRON_M = tuned(
    2.0,
    "m",
    "between what is sure and the smooth heights, over which one passes into the other: with less, it is "
    "a wall, with more, small woods have no inside",
)
_SQUARE_M = tuned(1.0, "m", "side of the squares in which is smoothed: a quarter of the Gaussian")


def calmed(ground: GroundSurface) -> GroundSurface:
    """The surface, and where it isn't sure a smooth one through its heights, which it passes into over an
    apron; itself where deviations aren't known."""
    if ground.sd_m is None:
        return ground
    unsure = _wide(ground.sd_m > _UNSURE_NODES * ground.spacing_m, ground.spacing_m)
    if not unsure.any():
        return ground
    inside_m = cv2.distanceTransform(unsure.view(np.uint8), cv2.DIST_L2, 5) * ground.spacing_m
    up = ground.up_m.astype(np.float32)
    calm = np.where(unsure, _smooth(up, ground.spacing_m), up)
    up = filled(calm, ~unsure | (inside_m > _APRON_M))
    return replace(ground, up_m=np.where(unsure, up, ground.up_m))


def _wide(flags: Bools, spacing_m: float) -> Bools:
    """What is left of flags when nothing narrow counts, with the holes in it that are as narrow."""
    side = 2 * round(max(_WIDE_M / spacing_m, _WIDE_NODES) / 2.0) + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    opened = cv2.morphologyEx(flags.view(np.uint8), cv2.MORPH_OPEN, disk)
    return np.asarray(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, disk) > 0)


def _smooth(up: Floats32, spacing_m: float) -> Floats32:
    """Heights (rows, cols) without single ones that are far off, smoothed in squares."""
    rows, cols = up.shape
    by = max(_SQUARE_M / spacing_m, 1.0)
    size = max(round(cols / by), 1), max(round(rows / by), 1)
    small = cv2.medianBlur(cv2.resize(up, size, interpolation=cv2.INTER_AREA), 5)
    small = cv2.GaussianBlur(small, (0, 0), _CALM_M / (spacing_m * by), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(small, (cols, rows), interpolation=cv2.INTER_LINEAR), dtype=np.float32)
