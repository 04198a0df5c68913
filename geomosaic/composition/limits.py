"""Up to where a frame gives pixels: how far off the vertical, and how coarsely it sees the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats, Floats32
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned
from geomosaic.projection.footprint import FEW, sightings
from geomosaic.projection.ground import GroundSurface

OFF_VERTICAL_DEG = sourced(60.0, "degrees", "steepest view: beyond, heights move the map 1.7 times", "tan 60")
COARSER = tuned(4.0, "mosaic px", "coarsest view used: beyond, 15 of 16 pixels are invented")
_FAR_INSIDE = sourced(2.0, "limits", "cap: beyond, a place is good enough", "definition")


@dataclass(frozen=True)
class Limits:
    """The largest tangent of the angle off the vertical, and a pixel's longest side on the ground in m."""

    tangent: float
    pixel_m: float

    @property
    def own_m(self) -> float:
        """The pixel that the limits were set by."""
        return self.pixel_m / COARSER

    def quality(self, tangent: Floats, pixel_m: Floats) -> Floats32:
        """How well places are seen: 1 at the limit, less beyond it, 0 at the horizon. What lies beyond the
        lens is left to the lens."""
        with np.errstate(divide="ignore", invalid="ignore"):
            by_angle = np.where(np.isnan(tangent), np.inf, self.tangent / np.abs(tangent))
            found = np.fmin(by_angle, self.pixel_m / pixel_m)
        found[np.isinf(tangent)] = 0.0
        return np.asarray(np.clip(found, 0.0, _FAR_INSIDE), dtype=np.float32)


def limits_of(
    poses: Poses, cameras: Sequence[Camera], used: Sequence[bool], ground: GroundSurface, pixel_m: float
) -> Limits:
    """The limits of a survey; the angle's is lifted where hardly a frame's middle is seen within it.

    Args: pixel_m: of the mosaic, or of the frames where that is larger.
    """
    most = float(np.tan(np.radians(OFF_VERTICAL_DEG)))
    middles = [
        float(sightings(poses[i], c, ground, np.array([[c.width_px / 2.0, c.height_px / 2.0]]))[1][0])
        for i, c in enumerate(cameras)
        if used[i]
    ]
    steep = np.nan_to_num(middles, nan=np.inf) <= most
    oblique = steep.sum() <= FEW * len(middles)
    return Limits(np.inf if oblique else most, COARSER * pixel_m)
