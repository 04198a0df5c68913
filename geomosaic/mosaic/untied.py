"""Frames that match no other: positions alone place them, metres off, so they give what others don't."""

from __future__ import annotations

from collections.abc import Sequence

import shapely

from geomosaic.constants import tuned
from geomosaic.mosaic.limits import Limits
from geomosaic.mosaic.views import FrameView, seen_part
from geomosaic.projection.ground import GroundSurface

_SHOWN = tuned(
    0.5, "share of its land", "that tied frames show: more keeps misplaced frames, less loses land"
)


def needless(
    views: Sequence[FrameView], tied: Sequence[bool], ground: GroundSurface, limits: Limits
) -> frozenset[int]:
    """Frames without tie points of whose land, as far as they see it well, tied frames show most.

    A frame that overlaps others and yet matches none shows water or is spoiled, or lies elsewhere.
    """

    def outline(view: FrameView) -> shapely.Geometry:
        return shapely.MultiPoint(
            seen_part(view.pose, view.camera, ground, limits).points_m[:, :2]
        ).convex_hull

    alone = {view.frame: outline(view) for view in views if not tied[view.frame]}
    if not alone:
        return frozenset()
    shown = shapely.union_all([outline(view) for view in views if tied[view.frame]])
    return frozenset(
        i for i, land in alone.items() if shapely.intersection(land, shown).area >= _SHOWN * land.area > 0.0
    )
