"""The surface for the ortho: a matched surface, smoothed where its deviations are large."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats32
from geomosaic.constants import tuned
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.dtm import filled

_UNSURE_NODES = tuned(8.0, "node spacings", "deviation to smooth at: 6 cuts roofs; more leaves torn crowns")
_WIDE_M = tuned(2.5, "m", "least width of a smoothed area: less smooths single crowns")
_WIDE_NODES = tuned(12.0, "node spacings", "least width smoothed: 6 leaves 30.1 % wrong walls, not 23.9 %")
_SMOOTHING_M = tuned(4.0, "m", "Gaussian: less still stretches what frames show; more makes woods lean")


def ortho_surface(ground: GroundSurface) -> GroundSurface:
    """The surface, and where it isn't sure a smooth one through its heights, which it passes into over an
    apron; itself where deviations aren't known."""
    if ground.sd_m is None:
        return ground
    unsure = _wide(ground.sd_m > _UNSURE_NODES * ground.spacing_m, ground.spacing_m)
    if not unsure.any():
        return ground
    inside_m = _away(unsure) * ground.spacing_m
    up = ground.up_m.astype(np.float32)
    smoothed = np.where(unsure, _smooth(up, ground.spacing_m), up)
    up = filled(smoothed, ~unsure | (inside_m > _SMOOTHING_M / 2.0))
    return replace(ground, up_m=np.where(unsure, up, ground.up_m))


def _wide(flags: Bools, spacing_m: float) -> Bools:
    """What is left of flags when nothing narrow counts, with the holes in it that are as narrow."""
    radius = round(max(_WIDE_M / spacing_m, _WIDE_NODES) / 2.0) + 0.25  # passes between nodes
    return ~_opened(~_opened(flags, radius), radius)


def _opened(flags: Bools, radius: float) -> Bools:
    """Where a disk of so many nodes fits into flags. What is beyond the grid is as its edge."""
    return ~(_away(~(_away(flags) > radius)) > radius)


def _away(flags: Bools) -> Floats32:
    """Of each flag the distance to the nearest node without one, in nodes."""
    return np.asarray(cv2.distanceTransform(flags.view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))


def _smooth(up: Floats32, spacing_m: float) -> Floats32:
    """Heights (rows, cols) without single ones that are far off, smoothed in squares."""
    rows, cols = up.shape
    by = max(_SMOOTHING_M / 4.0 / spacing_m, 1.0)
    size = max(round(cols / by), 1), max(round(rows / by), 1)
    small = cv2.medianBlur(cv2.resize(up, size, interpolation=cv2.INTER_AREA), 5)
    small = cv2.GaussianBlur(small, (0, 0), _SMOOTHING_M / (spacing_m * by), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(small, (cols, rows), interpolation=cv2.INTER_LINEAR), dtype=np.float32)
