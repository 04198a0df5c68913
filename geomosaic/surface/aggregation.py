"""The heights of neighbours go together: costs summed along paths through the tile.

The method is Hirschmueller 2008, Stereo processing by semiglobal matching and mutual information (PAMI 30),
over the cells of the ground instead of the pixels of an image. Each cell may have heights of its own. `steps`
(heights, rows, cols) has them in a ring, height k at place k mod heights. So cells that share a height have
it at the same place.
"""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bytes, Floats32, Ints
from geomosaic.constants import tuned
from geomosaic.surface.costs import PER_BIT, UNSEEN_COST
from geomosaic.surface.edge_refinement import AROUND_CELLS

Costs = NDArray[np.uint16]
Steps = NDArray[np.int16]
_SLOPE_BITS = tuned(1.5, "bits", "cost of one step: lower, noise becomes relief; higher, slopes are stairs")
_JUMP_BITS = tuned(7.0, "bits", "cost of any jump: lower, single cells leap; higher, house edges are cut")
_SLOPE_COST: Final = np.uint8(PER_BIT * _SLOPE_BITS)
_JUMP_COST: Final = np.uint8(PER_BIT * _JUMP_BITS)
_TURN: Final = np.uint8(32)
"""What distinguishes heights of one turn of the ring from those of the next: above what a jump costs, and
eight turns fill a byte."""


def ring(lowest: Steps, heights: int) -> Steps:
    """(heights, rows, cols) of the heights from lowest (rows, cols) up, each at its place in the ring."""
    place = np.arange(heights, dtype=np.int16)[:, None, None]
    return np.asarray(lowest + (place - lowest) % np.int16(heights), dtype=np.int16)


def aggregated(costs: Bytes, steps: Steps) -> Costs:
    """Costs (heights, rows, cols), 56 at most, summed along eight paths that end in each cell.

    steps: the same heights in every cell, upwards, or a `ring`.
    """
    heights, rows, cols = costs.shape
    shared = (steps == steps[0, 0, 0] + np.arange(heights, dtype=np.int16)[:, None, None]).all()
    turns = None if shared else (steps // np.int16(heights)).astype(np.uint8) * _TURN
    total = np.zeros((rows, heights, cols), dtype=np.uint16)
    _add_paths(
        total, costs.transpose(1, 0, 2), None if turns is None else turns.transpose(1, 0, 2), (-1, 0, 1)
    )
    by_cols = np.zeros((cols, heights, rows), dtype=np.uint8)
    across = [None if a is None else np.ascontiguousarray(a.transpose(2, 0, 1)) for a in (costs, turns)]
    assert across[0] is not None
    _add_paths(by_cols, across[0], across[1], (0,))
    total += by_cols.transpose(2, 1, 0)
    return total.transpose(1, 0, 2)


def _add_paths(total: NDArray[Any], costs: Bytes, turns: Bytes | None, aslant: tuple[int, ...]) -> None:
    """Adds the sums of paths from the first row to the last and back, each so many cols on with every row.

    What paths cost counts from their cheapest height, so that a byte holds it, and three paths' sum, or both
    ways' of one.

    Args: total, costs, turns (rows, heights, cols).
    """
    rows, heights, cols = costs.shape
    shape = heights, 2, len(aslant), cols
    path, best, other, here = (np.empty(shape, dtype=np.uint8) for _ in range(4))
    before, there = (np.full((heights + 2, *shape[1:]), 255 - _JUMP_COST, np.uint8) for _ in range(2))
    own, own_turns, summed = (np.empty((heights, 2, cols), dtype=np.uint8) for _ in range(3))
    near = (slice(0, -2), slice(2, None))
    for row in range(rows):
        both = row, rows - 1 - row
        for way, at in enumerate(both):
            own[:, way] = costs[at]
            if turns is not None:
                own_turns[:, way] = turns[at]
        if not row:
            best.fill(0)
        elif turns is None:
            np.minimum(before[near[0]], before[near[1]], out=best)
            best += _SLOPE_COST
            np.minimum(best, before[1:-1], out=best)
        else:
            here[:] = own_turns[:, :, None]
            np.bitwise_xor(there[1:-1], here, out=best)
            best |= before[1:-1]
            before += _SLOPE_COST
            for at in near:
                np.bitwise_xor(there[at], here, out=other)
                other |= before[at]
                np.minimum(best, other, out=best)
        np.minimum(best, _JUMP_COST, out=best)
        np.add(best, own[:, :, None], out=path)
        np.sum(path, axis=2, dtype=np.uint8, out=summed)
        for way, at in enumerate(both):
            total[at] += summed[:, way]
        path -= path.min(axis=0)
        _move(path, before[1:-1], aslant)
        if turns is not None:
            before[0], before[-1] = before[-2], before[1]
            _move(own_turns[:, :, None], there[1:-1], aslant)
            there[0], there[-1] = there[-2] + _TURN, there[1] - _TURN


def _move(values: Bytes, to: Bytes, aslant: tuple[int, ...]) -> None:
    """Values (heights, 2, paths or 1, cols) to where the paths go on; at the tile's edge a path begins with
    its own cell."""
    for k, by in enumerate(aslant):
        of_path, moved = values[:, :, min(k, values.shape[2] - 1)], to[:, :, k]
        moved[:] = of_path
        if by > 0:
            moved[..., 1:] = of_path[..., :-1]
        elif by < 0:
            moved[..., :-1] = of_path[..., 1:]


def cheapest(total: Costs, steps: Steps) -> Floats32:
    """The height of each cell (rows, cols) in steps, between them by a parabola."""
    heights = len(total)
    place = total.argmin(axis=0)
    low, middle, high = (_taken(total, (place + by) % heights).astype(np.float32) for by in (-1, 0, 1))
    step, below, above = (_taken(steps, (place + by) % heights) for by in (0, -1, 1))
    bend = low - 2.0 * middle + high
    inside = (below == step - 1) & (above == step + 1) & (bend > 0.0)
    off = np.where(inside, (low - high) / (2.0 * np.where(inside, bend, 1.0)), 0.0)
    return np.asarray(step + off.clip(-0.5, 0.5), dtype=np.float32)


def distinctness(costs: Bytes, total: Costs) -> Floats32:
    """By how many bits the heights of a cell and those around cost less than the mean of all heights. A
    height that costs as much as what no two frames see counts as 0."""
    chosen = np.take_along_axis(costs, total.argmin(axis=0)[None], axis=0)[0]
    less = (costs.mean(axis=0, dtype=np.float32) - chosen) / np.float32(PER_BIT)
    less[chosen >= UNSEEN_COST] = 0.0
    window = (AROUND_CELLS, AROUND_CELLS)
    return np.asarray(cv2.blur(less.astype(np.float32), window), dtype=np.float32)


def _taken(values: NDArray[np.integer], place: Ints) -> NDArray[np.integer]:
    return np.asarray(np.take_along_axis(values, place[None], axis=0)[0])
