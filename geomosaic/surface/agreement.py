"""Which of the frames that see a place show the same there: some lie a few pixels off the others.

Where an adjustment leaves frames in groups, each right within itself, a frame of a small group is like hardly
any other at any height. If all frames are compared with it, level land becomes noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.surface.census import NOT_SEEN, Bits
from geomosaic.surface.costs import AGREEING, CHANCE_BITS, SweepHeights, sampled
from geomosaic.surface.plane_sweep import Block, PlaneSweep
from geomosaic.surface.visibility import Asked

_EVERY_CELLS = tuned(4, "cells", "between cells at which frames are compared: 1 takes 16 times as long")
_MARGIN_BITS = tuned(0.5, "bits", "by which the steepest may agree worse and be first; 3 px off cost 2 to 4")
_LEAST_SHARE = tuned(0.5, "share", "of the best likeness, to be asked early: less lets unlike frames in")


def agreeing(
    sweep: PlaneSweep, seen: Sequence[Bits], heights: SweepHeights, asked: Asked, most: int
) -> list[tuple[Block, tuple[int, ...]]]:
    """The frames that are asked in each block, at most `most`, reordered. The first is the first one that
    agrees with others. Those that agree with it follow, then the rest, each group in its given order.

    Args: seen: censuses of the sweep's frames. heights: among which the right one is.
    """
    found = []
    for at, frames in asked:
        if len(frames) > AGREEING:
            frames = _in_order(frames, _likeness(sweep, seen, heights, at, frames))
        found.append((at, tuple(frames[:most])))
    return found


def _in_order(frames: Sequence[int], likeness: Floats) -> list[int]:
    of_each = np.sort(likeness, axis=1)[:, -AGREEING:].mean(axis=1)
    first = int(np.argmax(of_each >= of_each.max() - _MARGIN_BITS))
    others = likeness[first] < _LEAST_SHARE * likeness[first].max()
    return [frames[k] for k in sorted(range(len(frames)), key=lambda k: (k != first, others[k]))]


def _likeness(
    sweep: PlaneSweep, seen: Sequence[Bits], heights: SweepHeights, at: Block, frames: Sequence[int]
) -> Floats:
    """By how many bits fewer than by chance each two frames (frames, frames) differ over a block, at the
    height at which they differ least; 0 on the diagonal."""
    rows, cols = (slice(s.start, s.stop, _EVERY_CELLS) for s in at)
    bent = sweep.bent(heights.metres((slice(None), rows, cols)))
    shape = len(frames), len(bent), -1
    bits = np.stack([sampled(seen[k], *sweep.places(k, bent, (rows, cols))) for k in frames]).reshape(shape)
    lacking = bits >= NOT_SEEN
    some_lack = bool(lacking.any())
    found = np.zeros((len(frames), len(frames)))
    for k in range(len(frames) - 1):
        differing = np.bitwise_count(bits[k] ^ bits[k + 1 :])
        if some_lack:
            differing[lacking[k] | lacking[k + 1 :]] = CHANCE_BITS
        found[k, k + 1 :] = CHANCE_BITS - differing.mean(axis=2, dtype=np.float32).min(axis=1)
    return np.asarray(found + found.T)
