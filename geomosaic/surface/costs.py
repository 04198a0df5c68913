"""How differently frames show the points of a plane sweep: the cost of every height."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bytes, Floats32
from geomosaic.constants import sourced, tuned
from geomosaic.surface.census import BITS, NOT_SEEN, Bits
from geomosaic.surface.plane_sweep import SWEPT_AT_ONCE, PlaneSweep
from geomosaic.surface.visibility import Asked

Steps = NDArray[np.int16]
_MOST_BITS = tuned(14, "bits", "cap a frame: 12 differ by chance; lower, bad views count as mismatches")
AGREEING = sourced(2, "frames", "best after the first", "simulated towns: 1 to 3 % wrong roofs, 3: 2 to 7 %")
CHANCE_BITS: Final = BITS // 2
"""That differ by chance."""
_UNSEEN_BITS = tuned(8, "bits", "cost of a height that < 2 frames see: more favours seen ones; less unseen")
_CHANCE_FRAMES = tuned(0.3, "frames", "weight of chance: with 0 one agreeing frame counts as two")
PER_BIT: Final = 4
"""Costs count in quarters of a bit."""
UNSEEN_COST: Final = PER_BIT * _UNSEEN_BITS
_NONE: Final = np.uint8(255)


def _cost_of(frames: int, bits: int) -> int:
    if not frames:
        return UNSEEN_COST
    return round(PER_BIT * (bits + _CHANCE_FRAMES * CHANCE_BITS) / (frames + _CHANCE_FRAMES))


_PER_FRAME: Final = AGREEING * _MOST_BITS + 1
_COSTS: Final = np.array([_cost_of(*divmod(i, _PER_FRAME)) for i in range(256)], dtype=np.uint8)
"""By how many frames agree, times `_PER_FRAME`, and by how many bits they differ together."""
_COUNTED: Final = np.array([_PER_FRAME + min(bits, _MOST_BITS) for bits in range(256)], dtype=np.uint8)
"""One frame and its bits, by bits; nothing for none."""
_COUNTED[_NONE] = 0


@dataclass(frozen=True)
class SweepHeights:
    """Heights of a sweep: steps (heights, rows, cols) over the base, of step_m each."""

    steps: Steps
    step_m: float

    def metres(self, at: tuple[slice, ...]) -> Floats32:
        """Some of them over the base."""
        return np.asarray(self.steps[at].astype(np.float32) * np.float32(self.step_m))


def census_costs(
    sweep: PlaneSweep,
    seen: Sequence[Bits],
    heights: SweepHeights,
    asked: Asked,
    hidden_below_m: Mapping[int, Floats32],
) -> Bytes:
    """The mean number of bits, in quarters, in which the frames that agree best differ from the first one
    that sees the point.

    Args: seen: censuses of the sweep's frames. asked: blocks of cells, and the frames that are asked there,
    the steepest first. hidden_below_m: by frame, see `hidden_below`. Returns: as the heights' steps.
    """
    steps = heights.steps
    costs = np.full(steps.shape, _COSTS[0], dtype=np.uint8)
    for at, frames in asked:
        if len(frames) < 2:
            continue
        by = max(SWEPT_AT_ONCE // steps[0][at].size, 1)
        for first in range(0, len(steps), by):
            here = (slice(first, first + by), *at)
            height_m = heights.metres(here)
            bent = sweep.bent(height_m)
            found = []
            for k in frames:
                bits = sampled(seen[k], *sweep.places(k, bent, at))
                if k in hidden_below_m:
                    bits[height_m < hidden_below_m[k][at]] = NOT_SEEN
                found.append(bits)
            costs[here] = _cost(found)
    return costs


def _cost(found: Sequence[Bits]) -> Bytes:
    lacking = [bits >= NOT_SEEN if bits.max() >= NOT_SEEN else None for bits in found]
    first, of_first = found[0], None
    without = lacking[0]
    if without is not None:
        first, of_first = first.copy(), np.zeros(first.shape, dtype=np.uint8)
        for k, bits in enumerate(found[1:], 1):
            if not without.any():
                break
            np.copyto(first, bits, where=without)
            of_first[without] = k
            without = first >= NOT_SEEN
    best = [np.full(first.shape, _NONE, dtype=np.uint8) for _ in range(AGREEING)]
    for k, (bits, none) in enumerate(zip(found, lacking, strict=True)):
        if of_first is None and k == 0:
            continue
        differing = np.bitwise_count(bits ^ first)
        if none is not None:
            differing[none] = _NONE
        if of_first is not None:
            differing[of_first == k] = _NONE
        for rank, least in enumerate(best):
            worse = np.maximum(differing, least) if rank + 1 < AGREEING else differing
            np.minimum(differing, least, out=least)
            differing = worse
    counted = [cv2.LUT(least.reshape(len(least), -1), _COUNTED) for least in best]
    which = np.asarray(np.sum(counted, axis=0, dtype=np.uint8))
    if without is not None:
        which[without.reshape(which.shape)] = 0
    costs: Bytes = np.asarray(cv2.LUT(which, _COSTS), dtype=np.uint8)
    return costs.reshape(first.shape)


def sampled(view: Bits, cols: Floats32, rows: Floats32) -> Bits:
    """The nearest pixels' census; floats are moved as they are."""
    flat = cols.reshape(-1, cols.shape[-1]), rows.reshape(-1, cols.shape[-1])
    border = cv2.BORDER_CONSTANT
    found = cv2.remap(view.view(np.float32), *flat, cv2.INTER_NEAREST, borderMode=border, borderValue=-0.0)
    return np.asarray(found).view(np.uint32).reshape(cols.shape)
