"""The surface that was matched between frames: heights of cells, how sure, and by how many frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.arrays import Bytes, Floats, Floats32
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells

DENSE: Final = "dense"
"""The kind of ground that such a surface is."""


@dataclass(frozen=True)
class DenseSurface:
    """Of the middles of cells, (rows, cols) each, from the south up: up_m in the work frame; sd_m, its
    deviation (m), NaN where none is known; views: number of frames that agree there, 0 in filled voids."""

    cells: Cells
    up_m: Floats32
    sd_m: Floats32
    views: Bytes

    def ground(self) -> GroundSurface:
        """As what rays are projected on: a node in each cell's middle."""
        east, north = self.cells.axes_m()
        return GroundSurface(DENSE, float(east[0]), float(north[0]), self.cells.cell_m, self.up_m, self.sd_m)

    def sampled_m(self, most: int) -> Floats:
        """About so many points (n, 3) in the work frame, every k-th cell of every k-th row, of cells where
        frames agree."""
        by = max(1, math.isqrt(max(self.up_m.size - 1, 0) // most) + 1)
        at = np.s_[by // 2 :: by, by // 2 :: by]
        east, north = np.meshgrid(*self.cells.axes_m())
        points = np.stack([east[at], north[at], self.up_m[at]], axis=-1)
        return np.asarray(points[self.views[at] > 0], dtype=np.float64)
