"""What is to be said of a matched surface: where its frames could not show it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import numpy as np

from geomosaic.constants import CHOSEN, Because
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.levels import Level
from geomosaic.surface.model import DenseSurface
from geomosaic.surface.refinement import UNSEEN
from geomosaic.surface.tile import Heights

_LEAST_MATCHED: Annotated[
    float,
    Because("share", "of the cells that frames look at, below which the surface is hardly one", CHOSEN),
] = 0.3
_END_CELLS: Annotated[
    float, Because("cells", "of height from an end of what is searched that count as its end", CHOSEN)
] = 4.0
_MOST_AT_END: Annotated[
    float,
    Because("share", "of the cells that were matched at an end of what is searched, or past it", CHOSEN),
] = 0.1


def doubts(
    surface: DenseSurface, found: Heights, base: GroundSurface, level: Level
) -> Iterator[tuple[str, str]]:
    """Code and text of each warning.

    Args: found: the heights that it was made of; level: one of those that it was matched by.
    """
    views = surface.views[found.alike > UNSEEN]
    matched = float(np.mean(views > 0)) if views.size else 0.0
    agreeing = found.views[found.views > 0]
    if matched < _LEAST_MATCHED:
        yield (
            "surface-not-matched",
            f"frames show the same in {100.0 * matched:.0f} % of the cells alone (water, blank or moving "
            "ground, too little overlap, or ground far off what was known before); elsewhere the surface is "
            "held by what was known before",
        )
    elif agreeing.size and float(np.median(agreeing)) < 3.0:
        yield (
            "surface-two-views",
            "most of the surface is shown by two frames only, so that nothing contradicts a mistake; more "
            "overlap would",
        )
    east, north = surface.cells.axes_m()
    over_m = (surface.up_m - base.up_at(east, north[:, None]))[surface.views > 0]
    end_m = _END_CELLS * surface.cells.cell_m
    beyond = (over_m < level.lowest_m + end_m) | (over_m > level.highest_m - end_m)
    if over_m.size and float(np.mean(beyond)) > _MOST_AT_END:
        yield (
            "surface-out-of-reach",
            f"{100.0 * float(np.mean(beyond)):.0f} % of the surface lies at the end of what is searched, "
            f"{-level.lowest_m:.0f} m below to {level.highest_m:.0f} m above the ground that was known "
            "before; an elevation model (--dem) tells where to search",
        )
