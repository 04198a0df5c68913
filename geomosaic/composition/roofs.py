"""Roofs that are put in place in a mosaic on the tie points' ground: those that frames agree on there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from geomosaic.arrays import Bools
from geomosaic.composition.objects import objects_between
from geomosaic.composition.roof_agreement import agreement
from geomosaic.composition.roof_outlines import refined
from geomosaic.composition.roof_views import Roof, RoofSeen, RoofsOfFrame, roof_candidate, roofs_seen
from geomosaic.composition.views import FrameView
from geomosaic.constants import tuned
from geomosaic.projection.ground import GroundSurface, RaisedObject
from geomosaic.spread import Spread
from geomosaic.survey.model import Frame

_TOGETHER_PX = tuned(
    2.5e7, "px", "of roofs judged at once, 20 bytes each: more take memory; fewer decode anew"
)


@dataclass(frozen=True)
class RaisedRoof:
    """A roof as what frames are rectified on, and the steepest of the survey's frames that see it whole."""

    on_ground: RaisedObject
    frame: int

    @classmethod
    def of(cls, roof: Roof, mask: Bools, frame: int) -> RaisedRoof:
        """The part of a roof's window (rows, cols) where mask is, without what is beyond."""
        ((rows, cols),) = ndimage.find_objects(mask.view(np.uint8))
        up_m = np.where(mask, roof.roof_m, np.float32(np.nan))[rows, cols].astype(np.float32)
        east_m, north_m = roof.west_m + roof.pixel_m * cols.start, roof.south_m + roof.pixel_m * rows.start
        return cls(RaisedObject(east_m, north_m, roof.pixel_m, up_m), frame)

    @property
    def mask(self) -> Bools:
        """Where it lies on its heights, (rows, cols) of `on_ground`."""
        return np.isfinite(self.on_ground.up_m)


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
    """The roofs that frames agree on. They are judged some at a time, each frame decoded once for these.

    grounds: the surface, the terrain below it on the same nodes, and the ground that all else lies on.
    """
    surface, terrain, base = grounds
    ground_m = base.up_at(*np.moveaxis(surface.nodes_m(), -1, 0)).astype(np.float32)
    labels = objects_between(surface, terrain)
    objects = enumerate(ndimage.find_objects(labels), start=1)
    found = (roof_candidate(surface, ground_m, labels, one, views) for one in objects)
    raised, candidates = list[RaisedRoof](), 0
    for roofs in _batches(roof for roof in found if roof is not None):
        raised += _judged(roofs, candidates, frames, views, spread)
        candidates += len(roofs)
    return FoundRoofs(tuple(raised), candidates)


def _batches(roofs: Iterable[Roof]) -> Iterator[list[Roof]]:
    """Roofs in their order, as many together as have `_TOGETHER_PX` in their windows, one at least."""
    some, pixels = list[Roof](), 0
    for roof in roofs:
        if some and pixels + roof.mask.size > _TOGETHER_PX:
            yield some
            some, pixels = [], 0
        some.append(roof)
        pixels += roof.mask.size
    if some:
        yield some


def _judged(
    roofs: Sequence[Roof], first: int, frames: Sequence[Frame], views: Sequence[FrameView], spread: Spread
) -> Iterator[RaisedRoof]:
    """Those of a batch that are raised. first: the number of its first roof, which names its results."""
    looks = {
        i: RoofsOfFrame(frames[view.frame], view, tuple(roof for roof in roofs if i in roof.frames))
        for i, view in enumerate(views)
        if any(i in roof.frames for roof in roofs)
    }
    keys = [(first, views[i].frame) for i in looks]
    shown = spread.map("roofs", roofs_seen, list(looks.values()), keys)
    of_frame = {i: iter(seen) for i, seen in zip(looks, shown, strict=True)}
    for roof in roofs:
        mask = _lies(roof, [next(of_frame[i]) for i in roof.frames], [views[i] for i in roof.frames])
        if mask is not None:
            yield RaisedRoof.of(roof, mask, views[roof.frames[0]].frame)


def _lies(roof: Roof, seen: Sequence[RoofSeen], views: Sequence[FrameView]) -> Bools | None:
    """The part of the window where the roof lies on its heights; None where it stays on the ground."""
    behind = roof.hides(roof.mask, views)
    if not agreement(roof.mask, seen, behind).likely:
        return None
    mask, behind = refined(roof, seen, views, behind)
    return mask if agreement(mask, seen, behind).raised else None
