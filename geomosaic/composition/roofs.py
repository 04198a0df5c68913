"""Roofs that are put in place in a mosaic on the tie points' ground: those that frames agree on there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Bools
from geomosaic.composition.objects import objects_between
from geomosaic.composition.roof_agreement import agreement
from geomosaic.composition.roof_outlines import refined
from geomosaic.composition.roof_views import Roof, RoofSeen, RoofsOfFrame, roof_candidate, roofs_seen
from geomosaic.composition.views import FrameView
from geomosaic.projection.ground import GroundSurface, RaisedObject
from geomosaic.spread import Spread
from geomosaic.survey.model import Frame


@dataclass(frozen=True)
class RaisedRoof:
    """A roof, the part (rows, cols) of its window that lies on its heights, and the steepest of the survey's
    frames that see it whole."""

    roof: Roof
    mask: Bools
    frame: int

    @property
    def on_ground(self) -> RaisedObject:
        """As what frames are rectified on."""
        up_m = np.where(self.mask, self.roof.roof_m, np.float32(np.nan)).astype(np.float32)
        return RaisedObject(self.roof.west_m, self.roof.south_m, self.roof.pixel_m, up_m)


@dataclass(frozen=True)
class FoundRoofs:
    """The roofs that are raised, and how many were looked at."""

    raised: tuple[RaisedRoof, ...]
    candidates: int


def raised_roofs(
    grounds: tuple[GroundSurface, GroundSurface, GroundSurface],
    frames: Sequence[Frame],
    views: Sequence[FrameView],
    spread: Spread,
) -> FoundRoofs:
    """The roofs that frames agree on; each frame is decoded once.

    grounds: the surface, the terrain below it on the same nodes, and the ground that all else lies on.
    """
    surface, terrain, base = grounds
    nodes = surface.nodes_m()
    ground_m = base.up_at(nodes[..., 0], nodes[..., 1]).astype(np.float32)
    labels = objects_between(surface, terrain)
    every = range(1, int(labels.max(initial=0)) + 1)
    found = (roof_candidate(surface, ground_m, labels, number, views) for number in every)
    roofs = [roof for roof in found if roof is not None]
    looks = {
        i: RoofsOfFrame(frames[view.frame], view, tuple(roof for roof in roofs if i in roof.frames))
        for i, view in enumerate(views)
        if any(i in roof.frames for roof in roofs)
    }
    shown = spread.map("roofs", roofs_seen, list(looks.values()), [views[i].frame for i in looks])
    of_frame = {i: iter(seen) for i, seen in zip(looks, shown, strict=True)}
    raised = []
    for roof in roofs:
        mask = _lies(roof, [next(of_frame[i]) for i in roof.frames], [views[i] for i in roof.frames])
        if mask is not None:
            raised.append(RaisedRoof(roof, mask, views[roof.frames[0]].frame))
    return FoundRoofs(tuple(raised), len(roofs))


def _lies(roof: Roof, seen: Sequence[RoofSeen], views: Sequence[FrameView]) -> Bools | None:
    """The part of the window where the roof lies on its heights; None where it stays on the ground."""
    if not agreement(roof, roof.mask, seen, views).likely:
        return None
    mask = refined(roof, seen, views)
    return mask if agreement(roof, mask, seen, views).raised else None
