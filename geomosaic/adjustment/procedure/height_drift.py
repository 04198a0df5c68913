"""Drifts and jumps of reported heights (weather, a new battery), detected against the adjusted block."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.model import Block
from geomosaic.arrays import Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.constants import tuned
from geomosaic.estimation.linear import inverse, least_squares, orthonormal
from geomosaic.placement.prior import position_assumed
from geomosaic.survey.model import Warn

_LEAST = tuned(4, "frames", "fewer: a drift is not separable from noise")
_DRIFTS = tuned(3.0, "stated deviations of a height", "less is covered by the heights' own deviation")
_CLEARLY = tuned(5.0, "its own deviations", "of the best of as many jumps as frames; less: chance")
_MOST = tuned(4, "jumps and slopes", "two batteries and a wrong barometer have two of each; more: noise")


@dataclass(frozen=True)
class HeightDrift:
    """Drift of reported heights in order of flight.

    order (n,): frames by time. metres (n,): drift of each, with mean 0. parts: the largest first: rise in m,
    and the place in `order` behind which it jumps, or None for a slope from end to end.
    """

    order: Ints
    metres: Floats
    parts: tuple[tuple[float, int | None], ...]

    def freed(self, block: Block) -> Block:
        """The block with heights without the drift."""
        at = block.poses.positions_m.copy()
        at[self.order, 2] -= self.metres
        return replace(block, poses=replace(block.poses, positions_m=at))

    def warnings(self, block: Block) -> list[Warn]:
        """The largest part as a warning."""
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


def height_drift(block: Block, poses: Poses, frames: Ints) -> HeightDrift:
    """The drift of reported minus adjusted heights of the given frames, as slopes and jumps.

    Forward selection: a line, a jump, or both at once where neither suffices, as long as each rise exceeds
    three stated deviations of a height and five of its own.
    """
    known = set(frames[~position_assumed(block.poses)[frames]].tolist())
    order = np.array([i for i in block.sequence if i in known], dtype=np.intp)
    n = len(order)
    if n < _LEAST:
        return HeightDrift(order, np.zeros(n), ())
    off_m = block.poses.positions_m[order, 2] - poses.positions_m[order, 2]
    off_m -= off_m.mean()
    least_m = _DRIFTS * float(np.median(block.poses.positions_sd_m[order, 2]))
    parts: tuple[int, ...] = ()
    rises = np.zeros(0)
    while grown := _with_one_more(off_m, parts, least_m):
        parts, rises = grown
    by_size = sorted(zip(rises.tolist(), parts, strict=True), key=lambda part: -abs(part[0]))
    return HeightDrift(order, rises @ _shapes(parts, n), tuple((r, k or None) for r, k in by_size))


def _with_one_more(
    off_m: Floats, parts: tuple[int, ...], least_m: float
) -> tuple[tuple[int, ...], Floats] | None:
    """The parts with the best one added, or a line and the best jump, and all rises (k,) in m; None where
    none is large and significant."""
    for line in ((), (0,)):
        others = (*parts, *line)
        if len(set(others)) < len(others) or len(others) >= min(_MOST, len(off_m) - 3):
            continue
        tried = (*others, _best(off_m, others))
        shapes = _shapes(tried, len(off_m))
        rises = least_squares(shapes.T, off_m)
        left = float(((off_m - rises @ shapes) ** 2).sum())
        sds = np.sqrt(np.diag(inverse(shapes @ shapes.T)) * left / (len(off_m) - 1 - len(rises)))
        if (np.abs(rises) > np.maximum(least_m, _CLEARLY * sds))[len(parts) :].all():
            return tried, rises
    return None


def _shapes(parts: tuple[int, ...], n: int) -> Floats:
    """A line (0), and jumps behind the k-th frame, that rise by 1 with mean 0, (parts, n)."""
    along = np.arange(n)
    shapes = [along / (n - 1.0) if k == 0 else (along > k).astype(np.float64) for k in parts]
    return np.array([s - s.mean() for s in shapes]).reshape(len(parts), n)


def _best(off_m: Floats, others: tuple[int, ...]) -> int:
    """The line or jump that reduces the squares most, given the other parts.

    All jumps at once, by running sums: a jump's product with a vector of mean 0 is the sum behind the jump.
    """
    n = len(off_m)
    (line,), q = _shapes((0,), n), orthonormal(_shapes(others, n).T)
    behind = np.arange(1, n - 2)  # two frames at least on either side

    def products(vectors: Floats) -> Floats:
        sums = vectors.sum(axis=0) - np.cumsum(vectors, axis=0)
        return np.concatenate([line[None] @ vectors, sums[behind]])

    squares = np.concatenate([[line @ line], (behind + 1.0) * (n - 1.0 - behind) / n])
    free = squares - (products(q) ** 2).sum(axis=1)
    along = products((off_m - q @ (q.T @ off_m))[:, None])[:, 0]
    gain = along**2 / np.where(free > 1e-9 * squares, free, np.inf)
    return int(np.concatenate([[0], behind])[gain.argmax()])
