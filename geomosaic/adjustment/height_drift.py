"""Heights that drift by weather or jump with a battery, told apart from the ground that the pictures show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Block
from geomosaic.camera.exterior import Poses
from geomosaic.placement.prior import position_assumed
from geomosaic.survey.model import Warn

Floats = NDArray[np.float64]
_LEAST = 4
_DRIFTS = 3.0
"""Stated deviations of a height: what is less, the heights' own deviation covers."""
_DRIFTS_CLEARLY = 5.0
"""Its own deviations, of the one that fits best of as many as there are frames."""
_MOST = 4
"""Two slopes and two jumps: a flight of two batteries and a wrong barometer; more would follow the noise."""


@dataclass(frozen=True)
class HeightDrift:
    """By how much told heights go astray in order of flight.

    order (n,): frames by time. metres (n,): of each, without their mean, which says where the block lies.
    parts: the largest first, its rise in metres and the place in `order` behind which it jumps, or None for
    a slope from end to end.
    """

    order: NDArray[np.intp]
    metres: Floats
    parts: tuple[tuple[float, int | None], ...]

    def freed(self, block: Block) -> Block:
        """The block with heights that drift no longer."""
        at = block.poses.positions_m.copy()
        at[self.order, 2] -= self.metres
        return replace(block, poses=replace(block.poses, positions_m=at))

    def warnings(self, block: Block) -> list[Warn]:
        """The largest part in words."""
        if not self.parts:
            return []
        rise_m, jump = self.parts[0]
        first, last = block.names[self.order[0]], block.names[self.order[-1]]
        does = f"drift by {rise_m:+.1f} m from {first} to {last}"
        if jump is not None:
            first, last = block.names[self.order[jump]], block.names[self.order[jump + 1]]
            does = f"jump by {rise_m:+.1f} m between {first} and {last}"
        stated_m = float(np.median(block.poses.positions_sd_m[self.order, 2]))
        more = f", and {len(self.parts) - 1} more such" if len(self.parts) > 1 else ""
        text = f"heights {does} against the pictures (stated deviation {stated_m:.1f} m){more}"
        return [Warn("heights-drift", first, f"{text}; set by the pictures")]


def height_drift(block: Block, poses: Poses, seen: NDArray[np.intp]) -> HeightDrift:
    """What told minus solved heights of the frames `seen` do in order of flight.

    One after the other, whichever explains most: a line through all, or a jump (another battery, another
    zero), or both where neither alone does; as long as each is more than three stated deviations of a height,
    and more than five of its own.
    """
    known = set(seen[~position_assumed(block.poses)[seen]].tolist())
    order = np.array([i for i in block.sequence if i in known], dtype=np.intp)
    n = len(order)
    if n < _LEAST:
        return HeightDrift(order, np.zeros(n), ())
    jumps = [np.where(np.arange(n) < k, -0.5, 0.5) for k in range(2, n - 1)]
    shapes = np.array([s - s.mean() for s in (np.linspace(-0.5, 0.5, n), *jumps)])
    off_m = block.poses.positions_m[order, 2] - poses.positions_m[order, 2]
    stated_m = float(np.median(block.poses.positions_sd_m[order, 2]))
    parts: tuple[int, ...] = ()
    rises = np.zeros(0)
    while grown := _grown(shapes, off_m, parts, _DRIFTS * stated_m):
        parts, rises = grown
    by_size = sorted(zip(rises.tolist(), parts, strict=True), key=lambda part: -abs(part[0]))
    return HeightDrift(order, rises @ shapes[list(parts)], tuple((r, k if k else None) for r, k in by_size))


def _grown(
    shapes: Floats, off_m: Floats, parts: tuple[int, ...], least_m: float
) -> tuple[tuple[int, ...], Floats] | None:
    """The parts with one more, or with a line and a jump more where neither alone is enough, and the rises of
    all; None where none is large and sure enough."""
    left = [k for k in range(len(shapes)) if k not in parts]
    for more in ([(k,) for k in left], [(0, k) for k in left if k and 0 in left]):
        fits = [(_fit(shapes[[*parts, *m]], off_m), (*parts, *m)) for m in more]
        fits = [f for f in fits if len(f[1]) <= min(_MOST, len(off_m) - 3)]
        if fits:
            (rises, sds, _), best = min(fits, key=lambda f: f[0][2])
            if (np.abs(rises) > np.maximum(least_m, _DRIFTS_CLEARLY * sds))[len(parts) :].all():
                return best, rises
    return None


def _fit(shapes: Floats, off_m: Floats) -> tuple[Floats, Floats, float]:
    """By least squares: how much of each shape (k, n) there is, its deviation, and what squares are left."""
    found, *_ = np.linalg.lstsq(shapes.T, off_m - off_m.mean(), rcond=None)
    left = float(((off_m - off_m.mean() - found @ shapes) ** 2).sum())
    cofactor = np.diag(np.linalg.pinv(shapes @ shapes.T))
    return found, np.sqrt(cofactor * left / (len(off_m) - 1 - len(found))), left
