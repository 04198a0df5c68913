"""Consistency filter: which matched heights are accepted, and their standard deviations."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Final

import cv2
import numpy as np

from geomosaic.arrays import Bytes, Floats32
from geomosaic.constants import tuned
from geomosaic.matching.displacement import LEAST_CORRELATION
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells
from geomosaic.surface.costs import AGREEING
from geomosaic.surface.edge_refinement import AROUND_CELLS, STEP_CELLS
from geomosaic.surface.refinement import SURE, UNSEEN
from geomosaic.surface.tile_sgm import PAST_HEIGHTS, TileHeights
from geomosaic.surface.void_fill import SHARE_AROUND

_ALIKE: Final = (0.2, 0.4, 0.6, 0.8, 1.0)
"""Correlations for which the two tables below hold; straight between."""
_SD_CELLS = tuned((1.0, 0.3, 0.15, 0.1, 0.05), "cells", "by correlation; 68 % of simulated ones are within")
_WRONG = tuned((0.5, 0.35, 0.22, 0.12, 0.02), "share", "that have a step's other height, by correlation")
_ASIDE_CELLS = tuned(0.3, "cells", "horizontal error: simulated crowns of slope 3 are off by 0.6 to 1.3")
_DISTINCT_BITS = tuned(4.5, "bits", "kept without correlation: simulated lakes stay below 4.6, woods do not")
_SUPPORT = tuned(0.12, "share", "sure cells around: lakes reach 0.05, so less keeps waves; 0.25 loses groves")
_EVENED_CELLS = tuned(9, "cells", "window of the bilateral filter: larger takes longer and rounds off ridges")
_NOISE_CELLS = tuned(0.4, "cells", "height noise, 2 to 3 deviations: larger removes kerbs and low walls")
_END = tuned(0.25, "share", "of the way up or down, the most that is its end: more reports level land")
_LIKE_AROUND_CELLS: Final = AROUND_CELLS // 2 + 1
"""Window for equal sure cells: crowns vary too much over more."""
RIM_CELLS: Final = 12
"""Margin around a tile that `consistent_heights` reads: six cells for support, four for the filter."""


@dataclass(frozen=True)
class MatchCounts:
    """Numbers of cells.

    looked_at: that two frames see. matched: with a view. beyond: of these, at an end of what was searched, or
    past it. alike: where frames are alike. by_two: of these, where only two are.
    """

    looked_at: int = 0
    matched: int = 0
    beyond: int = 0
    alike: int = 0
    by_two: int = 0

    def __add__(self, other: MatchCounts) -> MatchCounts:
        return MatchCounts(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    @property
    def share(self) -> float:
        """Of what two frames see, what was matched."""
        return self.matched / max(self.looked_at, 1)


@dataclass(frozen=True)
class FilteredTile:
    """The accepted heights of a tile's cells, (rows, cols) each: over_m, the height over the base,
    0 in voids; sd_m, NaN in voids; views, as a surface's."""

    over_m: Floats32
    sd_m: Floats32
    views: Bytes
    counted: MatchCounts


def consistent_heights(
    found: TileHeights, cells: Cells, base: GroundSurface, reach_m: tuple[float, float]
) -> FilteredTile:
    """The accepted heights of cells that have `RIM_CELLS` others on every side.

    Args: reach_m: from where to where over the base heights were searched.
    """
    east, north = cells.axes_m()
    base_m = base.up_at(east, north[:, None]).astype(np.float32)
    sure = (found.alike >= SURE).astype(np.float32)
    support = cv2.blur(sure, (AROUND_CELLS, AROUND_CELLS), borderType=cv2.BORDER_CONSTANT)
    witnessed = found.seeing > AGREEING
    distinct = witnessed & (found.distinct >= _DISTINCT_BITS)
    by_two = ~witnessed & (found.alike >= LEAST_CORRELATION) & (support >= SHARE_AROUND)
    by_two &= _support_at_same_height(found, cells.cell_m) >= SHARE_AROUND
    supported = by_two | (witnessed & (support >= _SUPPORT))
    kept = (supported | distinct) & (found.alike > UNSEEN)
    views = np.where(kept, np.maximum(found.views, np.uint8(2) * (distinct | by_two)), np.uint8(0))
    over_m = _bilateral(np.where(kept, found.up_m - base_m, np.float32(0.0)), cells.cell_m)
    sd_m = np.where(kept, _sd_m(found, cells.cell_m), np.float32(np.nan))
    inner = slice(RIM_CELLS, -RIM_CELLS), slice(RIM_CELLS, -RIM_CELLS)
    over_m, sd_m, views = (np.ascontiguousarray(a[inner]) for a in (over_m * kept, sd_m, views))
    end_m = np.minimum(PAST_HEIGHTS / 2.0 * cells.cell_m, _END * np.abs(reach_m))
    ends_m = reach_m + np.array([1.0, -1.0]) * end_m
    matched, alike = views > 0, found.views[inner]
    beyond = matched & ((over_m < ends_m[0]) | (over_m > ends_m[1]))
    of = found.alike[inner] > UNSEEN, matched, beyond, alike > 0, (alike > 0) & (alike <= AGREEING)
    return FilteredTile(over_m, sd_m, views, MatchCounts(*(int(cells.sum()) for cells in of)))


def _support_at_same_height(found: TileHeights, cell_m: float) -> Floats32:
    """The share of the cells around that are sure, and of the same height."""
    reach = _LIKE_AROUND_CELLS // 2
    rows, cols = found.up_m.shape
    sure = np.where(found.alike >= SURE, found.up_m, np.float32(np.inf))
    sure = np.pad(sure, reach, constant_values=np.float32(np.inf))
    count = np.zeros((rows, cols), dtype=np.uint8)
    for down in range(2 * reach + 1):
        for right in range(2 * reach + 1):
            apart = sure[down : down + rows, right : right + cols] - found.up_m
            count += np.abs(apart, out=apart) < np.float32(2.0 * STEP_CELLS * cell_m)
    return np.asarray(count / np.float32(_LIKE_AROUND_CELLS**2), dtype=np.float32)


def _sd_m(found: TileHeights, cell_m: float) -> Floats32:
    """Of matched heights: by how alike frames are, by the lean of the surface, by steps nearby."""
    own = cell_m * np.interp(found.alike, _ALIKE, _SD_CELLS)
    lean = np.hypot(*np.gradient(found.up_m))
    element = np.ones((AROUND_CELLS, AROUND_CELLS), dtype=np.uint8)
    apart = cv2.dilate(found.up_m, element) - cv2.erode(found.up_m, element)
    step = np.where(apart > AROUND_CELLS * cell_m / 4.0, apart, np.float32(0.0))
    wrong = np.sqrt(np.interp(found.alike, _ALIKE, _WRONG)) * step
    return np.asarray(np.sqrt(own**2 + (_ASIDE_CELLS * lean) ** 2 + wrong**2), dtype=np.float32)


def _bilateral(over_m: Floats32, cell_m: float) -> Floats32:
    """Without the noise of single cells; edges stay."""
    return np.asarray(
        cv2.bilateralFilter(over_m, _EVENED_CELLS, _NOISE_CELLS * cell_m, _EVENED_CELLS / 4.0), np.float32
    )
