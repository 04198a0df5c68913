"""Where rays first meet a grid of heights, walked cell by cell: no wall is stepped over, whatever its width.

The highest of every 2 x 2, 4 x 4, ... cells are kept as maximum mipmaps. (Tevs, Ihrke and Seidel 2008,
Maximum mipmaps for fast, accurate, and scalable dynamic height field rendering.) A ray that passes above a
square as a whole leaps over it, and asks a larger one next. Otherwise it asks a smaller one, down to a cell
between four nodes, in which heights along it are a parabola.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats, Ints
from geomosaic.constants import SLIGHT


def pyramid(up_m: NDArray[Any]) -> list[NDArray[Any]]:
    """The highest of the four nodes about each cell, then of 2 x 2 of these, and so on, down to one."""
    cells = np.maximum(np.maximum(up_m[:-1, :-1], up_m[1:, :-1]), np.maximum(up_m[:-1, 1:], up_m[1:, 1:]))
    levels = [cells]
    while max(cells.shape) > 1:
        ends = [(0, n % 2) for n in cells.shape]
        even = np.pad(cells, ends, mode="edge")
        cells = np.maximum(
            np.maximum(even[::2, ::2], even[1::2, ::2]), np.maximum(even[::2, 1::2], even[1::2, 1::2])
        )
        levels.append(cells)
    return levels


@dataclass(frozen=True)
class GridRays:
    """Rays over a grid of heights, n of them.

    start (n, 2): row and col, in nodes, where each begins, and high_m (n,) its height there. per_drop (n, 2):
    rows and cols for each metre that it descends. first, last (n,): metres of descent between which the
    ground is looked for; both lie within the grid.
    """

    start: Floats
    per_drop: Floats
    high_m: Floats
    first: Floats
    last: Floats


def first_drops(up_m: NDArray[Any], rays: GridRays) -> Floats:
    """How far (m) rays descend until they first meet heights (rows, cols); NaN where they don't."""
    per_drop, first, last = rays.per_drop, rays.first, rays.last
    if not first.size:
        return np.full(first.shape, np.nan)
    ends = np.concatenate([rays.start + per_drop * of[:, None] for of in (first, last)])
    low = np.minimum(np.floor(ends.min(axis=0)), np.array(up_m.shape) - 2.0).astype(np.intp)
    high = np.maximum(np.ceil(ends.max(axis=0)), low + 1.0).astype(np.intp)
    up_m = up_m[low[0] : high[0] + 1, low[1] : high[1] + 1]
    start = rays.start - low
    levels = pyramid(up_m)
    drop, level = first.copy(), np.full(first.shape, len(levels) - 1)
    found = np.full(first.shape, np.nan)
    rows, cols = levels[0].shape
    going = np.flatnonzero(drop <= last)
    while going.size:
        at, slope, here = start[going], per_drop[going], drop[going]
        size = 2.0 ** level[going]
        place = at + slope * here[:, None]
        cell = np.minimum(
            np.maximum(place // size[:, None], 0.0), np.array([rows - 1, cols - 1]) // size[:, None]
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            border = (cell + (slope > 0.0)) * size[:, None]
            leaves = np.where(slope != 0.0, (border - at) / slope, np.inf)
            past = SLIGHT / np.abs(slope).max(axis=1)
        leaves = np.minimum(np.maximum(leaves.min(axis=1), here), last[going])
        index = cell.astype(np.intp)
        top = _highest(levels, level[going], index)
        above = rays.high_m[going] - leaves > top
        deepest = level[going] == 0
        hit = np.full(going.shape, np.nan)
        look = np.flatnonzero(~above & deepest)
        if look.size:
            part = GridRays(at[look], slope[look], rays.high_m[going[look]], here[look], leaves[look])
            hit[look] = _within(up_m, index[look], part)
        met = np.isfinite(hit)
        found[going[met]] = hit[met]
        on = above | (deepest & ~met)
        drop[going[on]] = leaves[on] + np.where(np.isfinite(past[on]), past[on], np.inf)
        level[going] += np.where(above, 1, np.where(deepest, 0, -1))
        np.minimum(level, len(levels) - 1, out=level)
        going = going[~met & (drop[going] <= last[going])]
    return found


def _highest(levels: list[NDArray[Any]], level: Ints, index: Ints) -> Floats:
    top = np.empty(level.shape)
    for k in np.unique(level).tolist():
        mine = level == k
        top[mine] = levels[k][index[mine, 0], index[mine, 1]]
    return top


def _within(up_m: NDArray[Any], cell: Ints, rays: GridRays) -> Floats:
    """The first drop at which each ray is at the heights between the four nodes of its cell."""
    i, j = cell.T
    low, right, upper, both = (
        up_m[i + di, j + dj].astype(np.float64) for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1))
    )

    def over(drop: Floats) -> Floats:
        v, u = (rays.start + rays.per_drop * drop[:, None] - cell).T
        return np.asarray(
            rays.high_m
            - drop
            - (low + (right - low) * u + (upper - low) * v + (low - right - upper + both) * u * v)
        )

    first, last = rays.first, rays.last
    middle, span = (first + last) / 2.0, last - first
    a, b, c = over(first), over(middle), over(last)
    square, linear = 2.0 * (a - 2.0 * b + c), -3.0 * a + 4.0 * b - c
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(linear * linear - 4.0 * square * a)
        ways = np.stack([2.0 * a / (-linear + root), 2.0 * a / (-linear - root)])
    ways = np.where((ways >= 0.0) & (ways <= 1.0 + 1e-9), ways, np.inf)
    share = np.where(a <= 0.0, 0.0, ways.min(axis=0))
    return np.where(np.isfinite(share), first + share * span, np.nan)
