"""The surface that was matched between frames: heights of cells, how sure, and by how many frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells

DENSE: Final = "dense"
"""The kind of ground that such a surface is."""


@dataclass(frozen=True)
class DenseSurface:
    """Of the middles of cells, (rows, cols) each, from the south up: up_m in the work frame; sd_m, its
    deviation (m), NaN where none is known; views: frames that agree there, 0 where the height is held by
    what was known before and by the cells around."""

    cells: Cells
    up_m: NDArray[np.float32]
    sd_m: NDArray[np.float32]
    views: NDArray[np.uint8]

    def ground(self) -> GroundSurface:
        """As what rays are projected on: a node in each cell's middle."""
        east, north = self.cells.axes_m()
        return GroundSurface(DENSE, float(east[0]), float(north[0]), self.cells.cell_m, self.up_m, self.sd_m)
