"""Heights that drift by weather or jump with a battery, distinguished from ground that the images show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Block
from geomosaic.camera.exterior import Poses
from geomosaic.constants import tuned
from geomosaic.estimation.linear import inverse, least_squares, orthonormal
from geomosaic.placement.prior import position_assumed
from geomosaic.survey.model import Warn

Floats = NDArray[np.float64]
_LEAST = tuned(4, "frames", "of which a drift can be distinguished from noise")
_DRIFTS = tuned(3.0, "stated deviations of a height", "what is less, the heights' own deviation covers")
_DRIFTS_CLEARLY = tuned(
    5.0,
    "its own deviations",
    "of the jump or slope that fits best of as many as there are frames: with less, one would be "
    "found by chance",
)
_MOST = tuned(
    4,
    "jumps and slopes",
    "a flight of two batteries and a wrong barometer has two of each; more would follow the noise",
)


@dataclass(frozen=True)
class HeightDrift:
    """By how much reported heights go astray in order of flight.

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
        text = f"heights {does} against the images (stated deviation {stated_m:.1f} m){more}"
        return [Warn("heights-drift", first, f"{text}; set by the images")]


def height_drift(block: Block, poses: Poses, seen: NDArray[np.intp]) -> HeightDrift:
    """What reported minus solved heights of the frames `seen` do in order of flight.

    One after the other, whichever explains most: a line through all, or a jump (another battery, another
    zero), or both where neither alone does; as long as each is more than three stated deviations of a height,
    and more than five of its own.
    """
    known = set(seen[~position_assumed(block.poses)[seen]].tolist())
    order = np.array([i for i in block.sequence if i in known], dtype=np.intp)
    n = len(order)
    if n < _LEAST:
        return HeightDrift(order, np.zeros(n), ())
    off_m = block.poses.positions_m[order, 2] - poses.positions_m[order, 2]
    off_m -= off_m.mean()
    stated_m = float(np.median(block.poses.positions_sd_m[order, 2]))
    parts: tuple[int, ...] = ()
    rises = np.zeros(0)
    while grown := _grown(off_m, parts, _DRIFTS * stated_m):
        parts, rises = grown
    by_size = sorted(zip(rises.tolist(), parts, strict=True), key=lambda part: -abs(part[0]))
    metres = rises @ _shapes(parts, n) if parts else np.zeros(n)
    return HeightDrift(order, metres, tuple((r, k or None) for r, k in by_size))


def _grown(off_m: Floats, parts: tuple[int, ...], least_m: float) -> tuple[tuple[int, ...], Floats] | None:
    """The parts with the one more that explains most, or with a line and a jump more where no one alone is
    enough, and the rises of all; None where none is large and sure enough."""
    for line in ((), (0,)):
        beside = (*parts, *line)
        if len(set(beside)) < len(beside) or len(beside) >= min(_MOST, len(off_m) - 3):
            continue
        tried = (*beside, _most_explaining(off_m, beside))
        rises, sds = _fit(_shapes(tried, len(off_m)), off_m)
        if (np.abs(rises) > np.maximum(least_m, _DRIFTS_CLEARLY * sds))[len(parts) :].all():
            return tried, rises
    return None


def _shapes(parts: tuple[int, ...], n: int) -> Floats:
    """A line (0), and jumps behind the k-th frame, that rise by 1 and have no mean, (parts, n)."""
    along = np.arange(n)
    shapes = [along / (n - 1.0) if k == 0 else (along > k).astype(np.float64) for k in parts]
    return np.array([s - s.mean() for s in shapes]).reshape(len(parts), n)


def _most_explaining(off_m: Floats, beside: tuple[int, ...]) -> int:
    """Which line or jump takes most off the squares that those beside it leave.

    All jumps at once, by running sums: what a jump has in common with a course without mean is the sum of
    the course behind it.
    """
    n = len(off_m)
    q = orthonormal(_shapes(beside, n).T)
    behind = np.arange(1, n - 2)  # two frames at least on either side

    def common(course: Floats) -> Floats:
        sums = course.sum(axis=0) - np.cumsum(course, axis=0)
        return np.concatenate([_shapes((0,), n) @ course, sums[behind]])

    line = _shapes((0,), n)[0]
    squares = np.concatenate([[line @ line], (behind + 1.0) * (n - 1.0 - behind) / n])
    free = squares - (common(q) ** 2).sum(axis=1)
    gain = common((off_m - q @ (q.T @ off_m))[:, None])[:, 0] ** 2 / np.where(
        free > 1e-9 * squares, free, np.inf
    )
    return int(np.concatenate([[0], behind])[gain.argmax()])


def _fit(shapes: Floats, off_m: Floats) -> tuple[Floats, Floats]:
    """By least squares: how much of each shape (k, n) there is, and its deviation."""
    found = least_squares(shapes.T, off_m)
    left = float(((off_m - found @ shapes) ** 2).sum())
    cofactors = np.diag(inverse(shapes @ shapes.T))
    return np.asarray(found), np.asarray(np.sqrt(cofactors * left / (len(off_m) - 1 - len(found))))
