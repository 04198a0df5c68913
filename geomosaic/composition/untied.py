"""Frames that match no other: positions alone place them, metres off, so they give what others don't."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from geomosaic.composition.limits import Limits
from geomosaic.composition.views import FrameView, SeenPart, seen_part
from geomosaic.projection.ground import GroundSurface


def needless(
    views: Sequence[FrameView], tied: Sequence[bool], ground: GroundSurface, limits: Limits
) -> frozenset[int]:
    """Frames without tie points that look beyond the limits for the most part, or of whose land, as far as
    they see it well, tied frames show most.

    A frame that overlaps others and yet matches none shows water or is spoiled, or lies elsewhere. One that
    looks at the horizon sees its land so far off the vertical that a degree of attitude moves it by metres.
    """

    def seen(view: FrameView) -> SeenPart:
        return seen_part(view.pose, view.camera, ground, limits)

    def outline(part: SeenPart) -> shapely.Geometry:
        return shapely.MultiPoint(part.points_m[:, :2]).convex_hull

    alone = {view.frame: seen(view) for view in views if not tied[view.frame]}
    if not alone:
        return frozenset()
    shown = shapely.union_all([outline(seen(view)) for view in views if tied[view.frame]])

    def needed(part: SeenPart) -> bool:
        if part.quality is not None and np.mean(part.quality >= 1.0) < 0.5:
            return False
        land = outline(part)
        return not shapely.intersection(land, shown).area >= 0.5 * land.area > 0.0

    return frozenset(frame for frame, part in alone.items() if not needed(part))
