"""The output grid that holds all frames, and the guard against one that holds the whole country."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from geomosaic.errors import InputError
from geomosaic.mosaic.model import OutputGrid
from geomosaic.mosaic.views import FrameView

MOST_PIXELS_PER_FRAME_PIXEL = 200.0


def auto_gsd_m(ground_pixel_m: float) -> float:
    """A survey's median ground sampling distance to three digits, so that grids have plain numbers."""
    return round(ground_pixel_m, 2 - math.floor(math.log10(ground_pixel_m)))


def output_grid(crs: str, views: Sequence[FrameView], gsd_m: float, names: Sequence[str]) -> OutputGrid:
    """The smallest grid at whole multiples of `gsd_m` that holds every frame's bounds.

    Args: names: of all the survey's frames, for the message.
    Raises: `InputError` if there is no frame, or if one wild position (or a ground pixel far too fine)
    would make the mosaic larger than 200 times all the frames' pixels.
    """
    if not views:
        raise InputError("no frame sees the ground", mend="check the positions, attitudes and heights")
    bounds = np.array([v.bounds_m for v in views])
    west, south = np.floor(bounds[:, :2].min(axis=0) / gsd_m + 1e-6)
    east, north = np.ceil(bounds[:, 2:].max(axis=0) / gsd_m - 1e-6)
    width, height = int(east - west), int(north - south)
    pixels = sum(v.camera.width_px * v.camera.height_px for v in views)
    if width * height > MOST_PIXELS_PER_FRAME_PIXEL * pixels:
        raise InputError(_blame(views, names, width * gsd_m, height * gsd_m, gsd_m))
    return OutputGrid(crs, float(west * gsd_m), float(north * gsd_m), gsd_m, max(width, 1), max(height, 1))


def _blame(
    views: Sequence[FrameView], names: Sequence[str], width_m: float, height_m: float, gsd_m: float
) -> str:
    middles = np.array([(v.bounds_m[:2] + v.bounds_m[2:]) / 2.0 for v in views])
    distances = np.linalg.norm(middles - np.median(middles, axis=0), axis=1)
    far = int(distances.argmax())
    typical = float(np.median([v.gsd_m for v in views]))
    if gsd_m < 0.2 * typical:
        mend = f"the ground pixel of {gsd_m:g} m is too fine for frames of {typical:.3g} m; make it coarser"
    else:
        mend = (
            f"frame {names[views[far].frame]} lies farthest out, {distances[far] / 1000.0:.1f} km "
            "from the middle; check its position and attitude or leave it out"
        )
    return f"the mosaic would be {width_m / 1000.0:.1f} x {height_m / 1000.0:.1f} km; {mend}"
