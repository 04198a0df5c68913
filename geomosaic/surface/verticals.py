"""Where frames see the points of verticals: image places by the height over a smooth base.

The vertical line locus (Bethel 1986; Linder 2016, Digital Photogrammetry, 4.6): a height is right where all
frames show the same there. A camera sees a point that rises towards it move by height over distance; with
u = h / (1 - h / H), H the camera's height over the base, that is all but linear in u for every camera that
flies about as high, and what a tilt, a lens or a rolling shutter bends is left to a square.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.constants import CHOSEN, Because
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
NODE_CELLS: Annotated[
    int,
    Because(
        "cells",
        "between nodes that go through the collinearity equations, bilinear between: a lens bends by less "
        "than 0.03 px over as much, and nodes cost nothing beside the cells",
        CHOSEN,
    ),
] = 8


@dataclass(frozen=True)
class Sighted:
    """How a frame looks: pose, camera, and how many of its pixels one of its picture is along each side."""

    pose: Pose
    camera: Camera
    reduction: float


class Verticals:
    """Verticals through a tile's cells, and where each of some frames sees their points."""

    def __init__(
        self,
        cells: Cells,
        base: GroundSurface,
        frames: Sequence[Sighted],
        lowest_m: float,
        highest_m: float,
    ) -> None:
        """lowest_m, highest_m: over the base, between which places are good to 0.1 px of a picture."""
        self._cells = cells
        down, across = (-(-n // NODE_CELLS) + 2 for n in (cells.rows, cells.cols))
        nodes = cells.part(-NODE_CELLS, -NODE_CELLS, 0, 0)
        east, north = Cells(nodes.west_m, nodes.south_m, cells.cell_m * NODE_CELLS, down, across).axes_m()
        ground = np.stack(
            np.broadcast_arrays(east, north[:, None], base.up_at(east, north[:, None])), axis=-1
        )
        self.base_m = self._at_cells(ground[..., 2])
        above = [float(f.pose.position_m[2] - ground[..., 2].mean()) for f in frames]
        self._away_m = np.float32(max(float(np.median(above)), 1.5 * highest_m))
        heights = np.linspace(lowest_m, highest_m, 3)
        powers = np.linalg.inv(np.vander(heights / (1.0 - heights / self._away_m), 3, increasing=True))
        self._terms = []
        for frame in frames:
            seen = np.stack(
                [
                    frame.pose.image_from_ground(frame.camera, ground + np.array([0.0, 0.0, h]))
                    for h in heights
                ]
            )
            terms = np.tensordot(powers, seen / frame.reduction, axes=1)
            terms[0] -= 0.5  # OpenCV counts from the first pixel's middle
            self._terms.append([[self._at_cells(term[..., axis]) for term in terms] for axis in (0, 1)])

    def bent(self, height_m: Floats32) -> Floats32:
        """What `places` takes, of heights over the base (rows, cols)."""
        return np.asarray(height_m / (np.float32(1.0) - height_m / self._away_m))

    def places(self, frame: int, bent: Floats32) -> tuple[Floats32, Floats32]:
        """Cols and rows in a frame's picture, (rows, cols) each, NaN where it doesn't see the point."""
        found = []
        for constant, linear, square in self._terms[frame]:
            place = square * bent
            place += linear
            place *= bent
            place += constant
            found.append(place)
        return found[0], found[1]

    def _at_cells(self, nodes: NDArray[Any]) -> Floats32:
        up = cv2.resize(
            nodes.astype(np.float32), None, fx=NODE_CELLS, fy=NODE_CELLS, interpolation=cv2.INTER_LINEAR
        )
        inner = (
            slice(NODE_CELLS, NODE_CELLS + self._cells.rows),
            slice(NODE_CELLS, NODE_CELLS + self._cells.cols),
        )
        return np.ascontiguousarray(up[inner])
