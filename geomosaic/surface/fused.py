"""What of the heights that were matched is kept, and how sure it is."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import sourced, tuned
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells
from geomosaic.surface.refinement import SURE, UNSEEN
from geomosaic.surface.tile import Heights

Floats32 = NDArray[np.float32]
_ALIKE: Final = (0.2, 0.4, 0.6, 0.8, 1.0)
"""Correlations for which the two tables below hold; straight between."""
_SD_CELLS: tuple[float, ...] = sourced(
    (1.0, 0.3, 0.15, 0.1, 0.05),
    "cells",
    "deviation of heights on open ground and on roofs, by correlation: 68 % and more are within",
    "computed of three simulated towns, 60 m to 120 m wide, cells of 0.4 m",
)
_WRONG: tuple[float, ...] = sourced(
    (0.5, 0.35, 0.22, 0.12, 0.02),
    "share",
    "of cells beside a step that have the other side's height, by correlation",
    "computed of the same towns: off by more than 1 m",
)
_ASIDE_CELLS = sourced(
    0.3,
    "cells",
    "by which crowns and walls may lie aside: what leans is as unsure as it is steep",
    "computed of the same towns: crowns that lean by 3 are 0.6 to 1.3 cells of height off",
)
_AROUND_CELLS = sourced(
    13,
    "cells",
    "side of the window in which steps are looked for, and cells about those that two frames see",
    "as far as `sharpening` looks",
)
_DISTINCT_BITS = sourced(
    4.5,
    "bits",
    "by which heights in and around a cell cost less than others, from which on they are kept even if no "
    "two frames look alike in small: crowns that wind moves",
    "computed: of the waves of six simulated lakes 95 in 100 cells stay below 4.25, all below 4.6; a "
    "real forest has 5.2 to 5.7, of which no frames correlate by more than 0.3",
)
_WITNESSES = sourced(
    3,
    "frames",
    "that see a cell, from which on it may be kept by its costs alone: between two some height costs "
    "little by chance, so that they have to look alike there, and around",
    "computed of a simulated town (seed 11): meadows at its rim, seen by two, rose by 14 to 24 m, by 5.6 "
    "bits less than other heights",
)
_LEAST_VIEWS = sourced(2, "frames", "that a match takes", "a pair")
_SUPPORT = sourced(
    0.12,
    "share",
    "of the cells around that were matched surely, below which a cell is held: water and blank roofs, "
    "where some match by chance; with more, crowns are given up, whose heights are better than what lies "
    "around",
    "computed: two simulated lakes reach 0.05; groves at a town's rim (seed 11), seen aslant by three "
    "and four, are off by more than 1 m 45 % with 0.25, 39 % with 0.12; 82 % within a deviation, not 70",
)
_LIKE_AROUND_CELLS = tuned(
    7,
    "cells",
    "side of the window in which sure cells of the same height are counted: a corner of a roof has a "
    "third of it; with 13 a crown's heights differ too much in it",
)
_LIKE_CELLS = sourced(
    5.0,
    "cells",
    "of height between cells that count as of the same: crowns rise by two to three from cell to cell",
    "computed of three simulated towns (seeds 5, 7, 11): with 2.5, and a share of 0.25, crowns off by "
    "more than 1 m are 0.5 to 1.9 % more",
)
_SUPPORT_OF_TWO = sourced(
    0.35,
    "share",
    "of the cells around that are sure and of the same height, where two frames alone see a cell: with "
    "less, cells that match by chance stand as masts along the border of what was matched; with more, "
    "crowns there are given up",
    "computed of the same towns: with 0.3 edges off by more than 1 m are 0.5 to 0.7 % more, with 0.4 "
    "trees are 0.2 to 0.7 % more",
)
_SURE_ABOUT_TWO = tuned(
    0.25,
    "share",
    "of the cells of the wider window that are sure, of whatever height, below which what two frames see "
    "is held: islands in woods that wind moves and on water; a corner of a roof has a quarter",
)
_LEAST_ALIKE = sourced(
    0.2,
    "correlation",
    "that such a cell itself has to have: below, nothing speaks for its height; edges of roofs have less "
    "than their middles",
    "computed of the same towns: with 0.4 roofs off by more than 1 m are 0.1 to 0.2 % more",
)
_EVENED_CELLS = tuned(
    9,
    "cells",
    "side of the window in which noise is evened out: a larger one takes longer and rounds off ridges",
)
_NOISE_CELLS = sourced(
    0.4,
    "cells",
    "of height that may be noise, two to three deviations; with more, kerbs and low walls go",
    "_SD_CELLS, see there",
)
RIM_CELLS: Final = 12
"""About a tile, that `fused` looks at: what is kept asks six around, and evening four around that."""
_END_CELLS = tuned(4.0, "cells", "of height from an end of what is searched that count as its end")


@dataclass(frozen=True)
class Counted:
    """Cells: looked_at, that two frames see; matched, with a view; beyond, of these at an end of what was
    searched, or past it; alike, where frames are alike; by_two, of these where only two are."""

    looked_at: int = 0
    matched: int = 0
    beyond: int = 0
    alike: int = 0
    by_two: int = 0

    def __add__(self, other: Counted) -> Counted:
        return Counted(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    @property
    def share(self) -> float:
        """Of what two frames see, what was matched."""
        return self.matched / max(self.looked_at, 1)


@dataclass(frozen=True)
class Part:
    """What was matched of a tile's cells, (rows, cols) each: over_m, the height over the base, 0 where it is
    held; sd_m, NaN where it is; views, as a surface's."""

    over_m: Floats32
    sd_m: Floats32
    views: NDArray[np.uint8]
    counted: Counted


def fused(found: Heights, cells: Cells, base: GroundSurface, reach_m: tuple[float, float]) -> Part:
    """What is kept of the heights of cells that have `RIM_CELLS` others on every side.

    Args: reach_m: from where to where over the base heights were searched.
    """
    east, north = cells.axes_m()
    base_m = base.up_at(east, north[:, None]).astype(np.float32)
    sure = (found.alike >= SURE).astype(np.float32)
    support = cv2.blur(sure, (_AROUND_CELLS, _AROUND_CELLS), borderType=cv2.BORDER_CONSTANT)
    witnessed = found.seeing >= _WITNESSES
    distinct = witnessed & (found.distinct >= _DISTINCT_BITS)
    by_two = ~witnessed & (found.alike >= _LEAST_ALIKE) & (support >= _SURE_ABOUT_TWO)
    by_two &= _sure_and_like(found, cells.cell_m) >= _SUPPORT_OF_TWO
    supported = by_two | (witnessed & (support >= _SUPPORT))
    kept = (supported | distinct) & (found.alike > UNSEEN)
    views = np.where(kept, np.maximum(found.views, np.uint8(_LEAST_VIEWS) * (distinct | by_two)), np.uint8(0))
    over_m = _even(np.where(kept, found.up_m - base_m, np.float32(0.0)), cells.cell_m)
    sd_m = np.where(kept, _sd_m(found, cells.cell_m), np.float32(np.nan))
    inner = slice(RIM_CELLS, -RIM_CELLS), slice(RIM_CELLS, -RIM_CELLS)
    over_m, sd_m, views = (np.ascontiguousarray(a[inner]) for a in (over_m * kept, sd_m, views))
    ends_m = np.array(reach_m) + np.array([1.0, -1.0]) * _END_CELLS * cells.cell_m
    matched, alike = views > 0, found.views[inner]
    beyond = matched & ((over_m < ends_m[0]) | (over_m > ends_m[1]))
    of = found.alike[inner] > UNSEEN, matched, beyond, alike > 0, (alike > 0) & (alike < _WITNESSES)
    return Part(over_m, sd_m, views, Counted(*(int(cells.sum()) for cells in of)))


def _sure_and_like(found: Heights, cell_m: float) -> Floats32:
    """The share of the cells around that are sure, and of the same height."""
    reach = _LIKE_AROUND_CELLS // 2
    rows, cols = found.up_m.shape
    sure = np.where(found.alike >= SURE, found.up_m, np.float32(np.inf))
    sure = np.pad(sure, reach, constant_values=np.float32(np.inf))
    count = np.zeros((rows, cols), dtype=np.uint8)
    for down in range(2 * reach + 1):
        for right in range(2 * reach + 1):
            apart = sure[down : down + rows, right : right + cols] - found.up_m
            count += np.abs(apart, out=apart) < np.float32(_LIKE_CELLS * cell_m)
    return np.asarray(count / np.float32(_LIKE_AROUND_CELLS**2), dtype=np.float32)


def _sd_m(found: Heights, cell_m: float) -> Floats32:
    """Of matched heights: by how alike frames are, by the lean of the surface, by steps nearby."""
    own = cell_m * np.interp(found.alike, _ALIKE, _SD_CELLS)
    lean = np.hypot(*np.gradient(found.up_m))
    element = np.ones((_AROUND_CELLS, _AROUND_CELLS), dtype=np.uint8)
    apart = cv2.dilate(found.up_m, element) - cv2.erode(found.up_m, element)
    step = np.where(apart > _AROUND_CELLS * cell_m / 4.0, apart, np.float32(0.0))
    wrong = np.sqrt(np.interp(found.alike, _ALIKE, _WRONG)) * step
    return np.asarray(np.sqrt(own**2 + (_ASIDE_CELLS * lean) ** 2 + wrong**2), dtype=np.float32)


def _even(over_m: Floats32, cell_m: float) -> Floats32:
    """Without the noise of single cells; edges stay."""
    return np.asarray(
        cv2.bilateralFilter(over_m, _EVENED_CELLS, _NOISE_CELLS * cell_m, _EVENED_CELLS / 4.0), np.float32
    )
