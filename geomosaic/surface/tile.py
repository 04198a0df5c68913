"""The heights of one tile's cells, matched between the frames that see it best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import CHOSEN, Because
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.aggregation import aggregated, cheapest, ring
from geomosaic.surface.cells import Cells
from geomosaic.surface.census import Bits, census
from geomosaic.surface.costs import census_costs
from geomosaic.surface.refinement import likeness, refined
from geomosaic.surface.verticals import Sighted, Verticals

Bytes = NDArray[np.uint8]
Floats32 = NDArray[np.float32]
MARGIN_CELLS: Annotated[
    int,
    Because(
        "cells",
        "about a tile, so that paths have gone some way where its own cells begin: with less, tiles are seen "
        "in the surface",
        CHOSEN,
    ),
] = 16
_NEAR_HEIGHTS: Annotated[
    int,
    Because(
        "heights",
        "about that of the level above, twelve of its half steps to either side: with less, what is narrower "
        "than its cells is lost, as masts and the rims of crowns",
        CHOSEN,
    ),
] = 24


@dataclass(frozen=True)
class Picture:
    """A frame as a level looks at it: grey (rows, cols), and its census."""

    grey: Bytes
    census: Bits


def picture(grey: Bytes, valid: Bytes | None) -> Picture:
    """valid (rows, cols): 0 where a pixel is not, None where all are."""
    return Picture(grey, census(grey, valid))


@dataclass(frozen=True)
class Search:
    """Where heights over the base are looked for: in steps of step_m from lowest_m to highest_m, or where
    `about_m` (rows, cols), heights in the work frame, is given, near those. fine: between the
    steps as well."""

    cells: Cells
    step_m: float
    lowest_m: float
    highest_m: float
    about_m: Floats32 | None
    fine: bool


@dataclass(frozen=True)
class Heights:
    """Of cells (rows, cols): up_m in the work frame; alike, how alike the frames are there, from -1 to 1;
    views, how many agree."""

    up_m: Floats32
    alike: Floats32
    views: Bytes


def matched(
    search: Search, base: GroundSurface, frames: Sequence[Sighted], pictures: Sequence[Picture]
) -> Heights:
    """Heights of cells, by the first frame and those that agree with it, two frames at least."""
    verticals = Verticals(search.cells, base, frames, search.lowest_m, search.highest_m)
    steps = _steps(search, verticals.base_m)
    costs = census_costs(verticals, [p.census for p in pictures], steps, search.step_m)
    height_m = _smoothed(cheapest(aggregated(costs, steps), steps) * np.float32(search.step_m))
    greys = [p.grey for p in pictures]
    if search.fine:
        height_m, alike, views = refined(verticals, greys, height_m, search.step_m)
        height_m = _smoothed(height_m)
    else:
        alike, views = likeness(verticals, greys, height_m)
    inner = slice(MARGIN_CELLS, -MARGIN_CELLS), slice(MARGIN_CELLS, -MARGIN_CELLS)
    return Heights((verticals.base_m + height_m)[inner], alike[inner], views[inner])


def _steps(search: Search, base_m: Floats32) -> NDArray[np.int16]:
    """(heights, rows, cols) that are looked at."""
    if search.about_m is None:
        lowest, highest = (round(end / search.step_m) for end in (search.lowest_m, search.highest_m))
        found = np.arange(lowest, highest + 1, dtype=np.int16)
        return np.broadcast_to(found[:, None, None], (len(found), *base_m.shape))
    middle = np.round((search.about_m - base_m) / np.float32(search.step_m)).astype(np.int16)
    return ring(middle - np.int16(_NEAR_HEIGHTS // 2), _NEAR_HEIGHTS)


def _smoothed(height_m: Floats32) -> Floats32:
    """Without single cells that leap off."""
    return np.asarray(cv2.medianBlur(height_m, 3), dtype=np.float32)
