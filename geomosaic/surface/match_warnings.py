"""What is to be said of a matched surface: where its frames could not show it."""

from __future__ import annotations

from collections.abc import Iterator

from geomosaic.constants import FEW, tuned
from geomosaic.surface.consistency_filter import MatchCounts
from geomosaic.surface.pyramid import PyramidLevel

_LEAST_MATCHED = tuned(0.3, "share", "of the cells that frames see: below, the surface is mostly filled")


def match_warnings(counted: MatchCounts, level: PyramidLevel, known: str) -> Iterator[tuple[str, str]]:
    """Code and text of each warning.

    Args: counted: the surface's cells; level: one of those that they were matched by; known: the kind of
    ground about which they were searched.
    """
    if counted.share < _LEAST_MATCHED:
        fix = "fly more overlap" if known == "dem" else "fly more overlap, or give --dem"
        yield (
            "surface-not-matched",
            f"frames agree on {100.0 * counted.share:.0f} % of the surface alone (water, blank or moving "
            f"ground, too little overlap, or ground far off what is known); the rest is interpolated: {fix}",
        )
    elif 2 * counted.by_two > counted.alike:
        yield (
            "surface-two-views",
            "most of the surface is shown by two frames only, so that mistakes in its heights stay "
            "undetected: fly more overlap",
        )
    beyond = counted.beyond / max(counted.matched, 1)
    if beyond > FEW:
        ground = "elevation model that was given" if known == "dem" else "ground from the tie points"
        fix = (
            "correct the level of its heights with --dem-offset"
            if known == "dem"
            else "give an elevation model with --dem"
        )
        yield (
            "surface-out-of-reach",
            f"{100.0 * beyond:.0f} % of the surface lies at the end of the search, "
            f"{-level.lowest_m:.0f} m below to {level.highest_m:.0f} m above the {ground}: relief is cut off "
            f"there; {fix}",
        )
