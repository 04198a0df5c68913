"""The heights of neighbours go together: costs summed along paths through the tile.

Hirschmueller 2008, Stereo processing by semiglobal matching and mutual information (PAMI 30), over the
cells of the ground instead of the pixels of an image. Each cell may have heights of its own: `steps`
(heights, rows, cols) holds them in a ring, height k at place k mod heights, so that cells that share a
height have it at the same place.
"""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import CHOSEN, Because
from geomosaic.surface.costs import PER_BIT, UNSEEN_COST

Costs = NDArray[np.int16]
Steps = NDArray[np.int16]
_SLOPE: Annotated[
    float,
    Because(
        "bits",
        "that a step up or down costs: with less, noise is taken for relief; with more, slopes become stairs",
        CHOSEN,
    ),
] = 1.5
_JUMP: Annotated[
    float,
    Because(
        "bits",
        "that a jump costs, however high: with less, single cells leap off; with more, edges of houses and "
        "crowns are cut across",
        CHOSEN,
    ),
] = 7.0
_DISTINCT_CELLS: Annotated[
    int,
    Because(
        "cells", "side of the window in which heights are told from chance: single cells can't be", CHOSEN
    ),
] = 13
_NEVER = np.int16(30000)


def ring(lowest: Steps, heights: int) -> Steps:
    """(heights, rows, cols) of the heights from lowest (rows, cols) up, each at its place in the ring."""
    place = np.arange(heights, dtype=np.int16)[:, None, None]
    return np.asarray(lowest + (place - lowest) % np.int16(heights), dtype=np.int16)


def aggregated(costs: NDArray[np.uint8], steps: Steps) -> Costs:
    """Costs (heights, rows, cols) summed along eight paths that end in each cell."""
    total = np.zeros(costs.shape, dtype=np.int16)
    for turned in (False, True):
        way = np.s_[:, ::-1] if turned else np.s_[:, :]
        _along_rows(costs[way], steps[way], total[way], (-1, 0, 1))
    by_cols, steps = (
        np.ascontiguousarray(costs.transpose(0, 2, 1)),
        np.ascontiguousarray(steps.transpose(0, 2, 1)),
    )
    across = np.zeros(by_cols.shape, dtype=np.int16)
    for turned in (False, True):
        way = np.s_[:, ::-1] if turned else np.s_[:, :]
        _along_rows(by_cols[way], steps[way], across[way], (0,))
    total += across.transpose(0, 2, 1)
    return total


def _along_rows(costs: NDArray[np.uint8], steps: Steps, total: Costs, aslant: tuple[int, ...]) -> None:
    """Adds the sums of paths from the first row to the last, each so many cols on with every row."""
    before: dict[int, tuple[Costs, Steps]] = {}
    for row in range(costs.shape[1]):
        here = steps[:, row]
        for by in aslant:
            path = costs[:, row].astype(np.int16)
            if row:
                path += _carried(*before[by], here)
            total[:, row] += path
            before[by] = _moved(path, by), _moved(here, by)


def _carried(path: Costs, there: Steps, here: Steps) -> Costs:
    """What the path's cells before, at heights there, add to those at heights here, (heights, cols)."""
    slope, jump = np.int16(PER_BIT * _SLOPE), np.int16(PER_BIT * _JUMP)
    least = path.min(axis=0)
    best = np.minimum(np.where(there == here, path, _NEVER), least + jump)
    for by in (1, -1):
        near, at = _rolled(path, by), _rolled(there, by)
        np.minimum(best, np.where(at == here - np.int16(by), near + slope, _NEVER), out=best)
    best -= least
    return np.asarray(best)


def _rolled(ring_: NDArray[np.int16], by: int) -> NDArray[np.int16]:
    """One place on in the ring of heights, or back."""
    return np.concatenate([ring_[-1:], ring_[:-1]] if by > 0 else [ring_[1:], ring_[:1]])


def _moved(path: NDArray[np.int16], by: int) -> NDArray[np.int16]:
    """One col on, or back; at the tile's edge the path begins with its own cell."""
    if by == 0:
        return path
    return np.concatenate([path[:, :1], path[:, :-1]] if by > 0 else [path[:, 1:], path[:, -1:]], axis=1)


def cheapest(total: Costs, steps: Steps) -> NDArray[np.float32]:
    """The height of each cell (rows, cols) in steps, between them by a parabola."""
    heights = len(total)
    place = total.argmin(axis=0)
    low, middle, high = (_taken(total, (place + by) % heights).astype(np.float32) for by in (-1, 0, 1))
    step, below, above = (_taken(steps, (place + by) % heights) for by in (0, -1, 1))
    bend = low - 2.0 * middle + high
    inside = (below == step - 1) & (above == step + 1) & (bend > 0.0)
    off = np.where(inside, (low - high) / (2.0 * np.where(inside, bend, 1.0)), 0.0)
    return np.asarray(step + off.clip(-0.5, 0.5), dtype=np.float32)


def distinctness(costs: NDArray[np.uint8], total: Costs) -> NDArray[np.float32]:
    """By how many bits the heights of a cell and those around cost less than the mean of all heights; those
    that cost as much as what no two frames see are no evidence."""
    chosen = np.take_along_axis(costs, total.argmin(axis=0)[None], axis=0)[0]
    less = (costs.mean(axis=0, dtype=np.float32) - chosen) / np.float32(PER_BIT)
    less[chosen >= UNSEEN_COST] = 0.0
    window = (_DISTINCT_CELLS, _DISTINCT_CELLS)
    return np.asarray(cv2.blur(less.astype(np.float32), window), dtype=np.float32)


def _taken(values: NDArray[np.int16], place: NDArray[np.intp]) -> NDArray[np.int16]:
    return np.asarray(np.take_along_axis(values, place[None], axis=0)[0])
