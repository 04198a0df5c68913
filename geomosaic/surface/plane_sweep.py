"""Where frames see the points of verticals: image places by the height over a smooth base.

The vertical line locus (Bethel 1986; Linder 2016, Digital Photogrammetry, 4.6): a height is right where all
frames show the same there. A camera sees a point that rises towards it move by height over distance. Let
`u = h / (1 - h / H)`, with H the camera's height over the base. The move is all but linear in u for every
camera that flies about as high. What a tilt, a lens or a rolling shutter bends is left to a square.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats, Floats32
from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.estimation.linear import inverse
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells

Block = tuple[slice, slice]
WHOLE: Final = (slice(None), slice(None))
NODE_CELLS = tuned(8, "cells", "between exact nodes: a lens bends by < 0.03 px over them; fewer take longer")
SWEPT_AT_ONCE = tuned(1 << 15, "points", "computed in one go: fewer cost calls; more do not fit a cache")
_REACH_SHARES = tuned((1.0, 0.25, 0.05), "share", "of the search, for fits: without low ones rims are lost")


@dataclass(frozen=True)
class SweepView:
    """How a frame looks: pose, camera, and how many of its pixels one of its picture is along each side."""

    pose: Pose
    camera: Camera
    reduction: float

    @property
    def turn_rad(self) -> float:
        """From east to the right side of the image, to the north."""
        east, north = self.pose.rotation.matrix[:2, :2]
        return float(np.arctan2(north[0] - east[1], east[0] + north[1]))


class PlaneSweep:
    """Verticals through a tile's cells, and where each of some frames sees their points."""

    def __init__(
        self,
        cells: Cells,
        base: GroundSurface,
        frames: Sequence[SweepView],
        lowest_m: float,
        highest_m: float,
    ) -> None:
        """lowest_m, highest_m: over the base, between which places are good to 0.1 px of a picture."""
        self._reach_m = lowest_m, highest_m
        down, across = (-(-n // NODE_CELLS) + 2 for n in (cells.rows, cells.cols))
        nodes = cells.part(-NODE_CELLS, -NODE_CELLS, 0, 0)
        east, north = Cells(nodes.west_m, nodes.south_m, cells.cell_m * NODE_CELLS, down, across).axes_m()
        ground = np.stack(
            np.broadcast_arrays(east, north[:, None], base.up_at(east, north[:, None])), axis=-1
        )
        self.frames = tuple(frames)
        above = [float(f.pose.position_m[2] - ground[..., 2].mean()) for f in frames]
        self._away_m = np.float32(max(float(np.median(above)), 1.5 * highest_m))
        self._nodes_terms = []
        for frame in frames:
            terms = self._terms_at(frame, ground) / frame.reduction
            terms[0] -= 0.5  # OpenCV counts from the first pixel's middle
            self._nodes_terms.append(np.moveaxis(terms, -1, 0))
        self.cells = cells
        self.base_m = self._at_cells(ground[..., 2])
        self._terms: dict[int, Floats32] = {}

    def _terms_at(self, frame: SweepView, ground: Floats) -> Floats:
        """Constant, linear and square (3, nodes north, nodes east, 2) of a frame's cols and rows; of nodes
        that it doesn't see at all heights, by those near the base."""
        found = np.full((3, *ground.shape[:2], 2), np.nan)
        for share in _REACH_SHARES:
            lacking = np.isnan(found).any(axis=(0, 3))
            if not lacking.any():
                break
            heights = np.linspace(*self._reach_m, 3) * share
            points = ground[lacking] + np.array([0.0, 0.0, 1.0]) * heights[:, None, None]
            seen = frame.pose.image_from_ground(frame.camera, points)
            bent = heights / (1.0 - heights / float(self._away_m))
            found[:, lacking] = np.tensordot(inverse(np.vander(bent, 3, increasing=True)), seen, axes=1)
        return _extrapolated(found)

    def terms(self, frame: int) -> Floats32:
        """Constant, linear and square (2, 3, rows, cols) of a frame's cols and rows, by `bent`."""
        if frame not in self._terms:
            nodes = self._nodes_terms[frame]
            self._terms[frame] = np.stack([np.stack([self._at_cells(t) for t in terms]) for terms in nodes])
        return self._terms[frame]

    def base_places(self, frame: int) -> list[Floats32]:
        """Cols and rows in a frame's picture of the base in each cell, as `places` has them."""
        return [self._at_cells(constant) for constant, _, _ in self._nodes_terms[frame]]

    def bent(self, height_m: Floats32) -> Floats32:
        """What `places` takes, of heights over the base (rows, cols)."""
        return np.asarray(height_m / (np.float32(1.0) - height_m / self._away_m))

    def places(self, frame: int, bent: Floats32, at: Block = WHOLE) -> tuple[Floats32, Floats32]:
        """Cols and rows in a frame's picture of points over the cells at a block, as bent (..., rows, cols);
        NaN where it doesn't see the point."""
        found = []
        for constant, linear, square in self.terms(frame):
            place = square[at] * bent
            place += linear[at]
            place *= bent
            place += constant[at]
            found.append(place)
        return found[0], found[1]

    def towards(self, frame: int, at: Block = WHOLE) -> tuple[Floats32, Floats32, Floats32]:
        """The direction from each cell of a block to below the camera, and the rise of a line of sight with
        each cell (m). The direction is in cells east and north, of length 1. All are (rows, cols)."""
        east, north = self.cells.axes_m()
        place = self.frames[frame].pose.position_m
        off = np.broadcast_arrays(place[0] - east[at[1]], (place[1] - north[at[0]])[:, None])
        right, up = (np.asarray(a, dtype=np.float32) for a in off)
        away_m: Floats32 = np.maximum(np.hypot(right, up), np.float32(1e-3))
        rise = (np.float32(place[2]) - self.base_m[at]) * np.float32(self.cells.cell_m) / away_m
        return np.asarray(right / away_m), np.asarray(up / away_m), np.asarray(rise)

    def _at_cells(self, nodes: NDArray[Any]) -> Floats32:
        up = cv2.resize(
            nodes.astype(np.float32),
            None,
            fx=NODE_CELLS,
            fy=NODE_CELLS,
            interpolation=cv2.INTER_LINEAR,
        )
        inner = (
            slice(NODE_CELLS, NODE_CELLS + self.cells.rows),
            slice(NODE_CELLS, NODE_CELLS + self.cells.cols),
        )
        return np.ascontiguousarray(up[inner])


def _extrapolated(terms: Floats) -> Floats:
    """Terms (3, rows, cols, 2), continued straight by one node past the last known ones. So cells between the
    last node that a lens sees and the next have a place."""
    found = terms.copy()
    for axis in (1, 2):
        for way in (slice(None), slice(None, None, -1)):
            inwards = np.moveaxis(terms, axis, 0)[way]
            out = np.moveaxis(found, axis, 0)[way]
            on = 2.0 * inwards[1:-1] - inwards[2:]
            out[:-2] = np.where(np.isnan(out[:-2]), on, out[:-2])
    return found
