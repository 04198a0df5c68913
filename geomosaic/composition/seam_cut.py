"""Seams where frames agree: cuts of least difference in colour, near the lines halfway between nadirs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats32
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.plugins import SEAMS_GROUP, Named
from geomosaic.composition.seam_parts import SeamPart, to_8_bits
from geomosaic.constants import tuned
from geomosaic.spread import AtOnce, Spread

_cv2: Any = cv2  # its stubs leave the stitching module out
_ON_OBJECTS = tuned(np.float32(40.0), "grey levels", "seam cost on objects: less cuts houses; grass costs 10")
_MANY_CELLS = tuned(16_000, "cells", "above, cut coarse to fine: less coarsens small parts; more is slow")
_ABOUT_CELLS = tuned(4, "cells", "refined next to a coarse seam: fewer keep its steps; more take time")


Seam = Callable[[Ownership, Sequence[SeamPart], Spread], Ownership]
"""Who owns what, by the ownership of the nearest nadir points and by what each frame may give. Work on many
items may be spread."""


@dataclass(frozen=True)
class Shared:
    """What two frames may give of some cells: `may` (h, w) and `values` (h, w, 1 or 3) of both. standing (h,
    w): where something stands on the ground, None if that is unknown."""

    may: tuple[Bools, Bools]
    values: tuple[NDArray[np.floating[Any]], NDArray[np.floating[Any]]]
    standing: Bools | None


def cut_seams(nearest: Ownership, parts: Sequence[SeamPart], spread: Spread | None = None) -> Ownership:
    """Pair by pair, what both frames may give is cut where they differ least, see `cut_pair`. It is shown no
    more of both frames than what they share and the cells about it: what is farther off is decided. Pairs
    are cut in rounds of such as have no frame in common, with the outcome of one after the other.
    """
    may, spread = [p.may.copy() for p in parts], spread or AtOnce()
    cut = partial(cut_pair, float(to_8_bits(parts)))
    for n, pairs in enumerate(_rounds(_meeting(parts), len(parts))):
        found = [(i, j, window) for i, j in pairs if (window := _window(parts, may, i, j)) is not None]
        jobs = [_shared(parts, may, *pair) for pair in found]
        cuts = spread.map("cuts", cut, jobs, [(n, i, j) for i, j, _ in found])
        for (i, j, window), job, first in zip(found, jobs, cuts, strict=True):
            both = job.may[0] & job.may[1]
            for k, mine in ((i, first), (j, ~first)):
                may[k][parts[k].at(*window)][both] = mine[both]
    owner = nearest.owner.copy()
    for part, mine in zip(parts, may, strict=True):
        owner[part.of_all][mine] = part.frame + 1
    return replace(nearest, owner=owner)


def _rounds(pairs: Sequence[tuple[int, int]], parts: int) -> list[list[tuple[int, int]]]:
    """Pairs that can be cut at once: each comes after all before it with a part of its own."""
    free, rounds = [0] * parts, list[list[tuple[int, int]]]()
    for i, j in pairs:
        n = max(free[i], free[j])
        free[i] = free[j] = n + 1
        if n == len(rounds):
            rounds.append([])
        rounds[n].append((i, j))
    return rounds


def _shared(
    parts: Sequence[SeamPart], may: Sequence[Bools], i: int, j: int, window: tuple[slice, slice]
) -> Shared:
    one, other = ((k, parts[k].at(*window)) for k in (i, j))
    high = parts[i].standing
    return Shared(
        (may[i][one[1]], may[j][other[1]]),
        (parts[i].values[one[1]], parts[j].values[other[1]]),
        None if high is None else high[one[1]],
    )


def cut_pair(scale: float, pair: Shared) -> Bools:
    """Where the first of two frames gives what both may, (h, w): the cut along which they differ least, by
    Kwatra et al. 2003, Graphcut textures, section 3. Seams keep off what stands on the ground, as if both
    differed the more there.

    Where they share much the cut is first made in cells twice as large, then in the cells about it: Lombaert
    et al. 2005, A multilevel banded graph cuts method. Args: scale: takes values to 8 bits.
    """
    shown = [_colours(values, scale) for values in pair.values]
    if pair.standing is not None:
        shown[0] += np.where(pair.standing, _ON_OBJECTS, np.float32(0.0))[..., None]
    one, other = pair.may
    both = one & other
    if np.count_nonzero(both) > _MANY_CELLS:
        first = _in_larger_cells(shown, one, other)
        far = both & ~_next_to_seam(first, one | other)
        one, other = one & ~(far & ~first), other & ~(far & first)
    return np.where(one & other, _least_cut(shown, one, other), one)


def _in_larger_cells(shown: Sequence[Floats32], one: Bools, other: Bools) -> Bools:
    """Where the first frame gives what both may, as cut in cells of 2 x 2; anything where only one may."""
    (height, width), (low, thin) = one.shape, (-(-n // 2) for n in one.shape)
    ends = [(0, 2 * low - height), (0, 2 * thin - width)]

    def anywhere(cells: Bools) -> Bools:
        return np.asarray(np.pad(cells, ends).reshape(low, 2, thin, 2).any(axis=(1, 3)))

    first, second, both = (anywhere(of) for of in (one & ~other, other & ~one, one & other))
    free = (first & second) | (both & ~first & ~second)
    halved: list[Any] = [
        cv2.resize(np.pad(of, [*ends, (0, 0)], mode="edge"), (thin, low), interpolation=cv2.INTER_AREA)
        for of in shown
    ]
    cut = np.where(free, _least_cut(halved, free | first, free | (second & ~first)), first)
    return np.asarray(cut.repeat(2, axis=0).repeat(2, axis=1)[:height, :width])


def _next_to_seam(first: Bools, seen: Bools) -> Bools:
    """The cells about the line between those of the first frame and those of the second one."""
    reach = np.ones((2 * _ABOUT_CELLS + 1,) * 2, np.uint8)
    sides = [cv2.dilate((of & seen).astype(np.uint8), reach) > 0 for of in (first, ~first)]
    return np.asarray(sides[0] & sides[1])


def _least_cut(shown: Sequence[Floats32], one: Bools, other: Bools) -> Bools:
    """What the first frame gives of what both may, by OpenCV's GraphCutSeamFinder."""
    finder = _cv2.detail_GraphCutSeamFinder("COST_COLOR")
    masks = [may.astype(np.uint8) * np.uint8(255) for may in (one, other)]
    return np.asarray(finder.find(list(shown), [(0, 0), (0, 0)], masks)[0].get()) > 0


def _colours(values: NDArray[np.floating[Any]], scale: float) -> Floats32:
    """Three bands: the three, or the one three times."""
    return np.broadcast_to(values.astype(np.float32) * np.float32(scale), (*values.shape[:2], 3)).copy()


def _meeting(parts: Sequence[SeamPart]) -> list[tuple[int, int]]:
    """Pairs of frames that have cells in common, by their bounds; the nearest by nadir points first, so
    that little is left to others."""
    bounds = shapely.box(
        *np.array([[p.col, p.row, p.of_all[1].stop, p.of_all[0].stop] for p in parts]).reshape(-1, 4).T
    )
    one, other = shapely.STRtree(bounds).query(bounds, predicate="intersects")
    one, other = one[one < other], other[one < other]
    nadir_m = np.array([p.nadir_m for p in parts]).reshape(-1, 2)
    away_m = np.linalg.norm(nadir_m[one] - nadir_m[other], axis=1)
    return [(int(one[k]), int(other[k])) for k in np.lexsort((other, one, away_m))]


def _window(parts: Sequence[SeamPart], may: Sequence[Bools], i: int, j: int) -> tuple[slice, slice] | None:
    """Rows and cols, of all cells, of what two frames may both give and, as far as both have them, of the
    cells about it."""
    rows, cols = (
        slice(max(a.start, b.start), min(a.stop, b.stop))
        for a, b in zip(parts[i].of_all, parts[j].of_all, strict=True)
    )
    both = may[i][parts[i].at(rows, cols)] & may[j][parts[j].at(rows, cols)]
    if not both.any():
        return None
    found = []
    for line, of in ((both.any(axis=1), rows), (both.any(axis=0), cols)):
        there = of.start + np.flatnonzero(line)
        found.append(slice(max(int(there[0]) - 1, of.start), min(int(there[-1]) + 2, of.stop)))
    return found[0], found[1]


NEAREST_NADIR: Final = "nearest_nadir"
SEAMS: Final[Mapping[str, Seam]] = Named(
    {"least_difference": cut_seams, NEAREST_NADIR: lambda nearest, parts, spread: nearest},
    SEAMS_GROUP,
    callable,
)
"""And what other distributions bring, see `plugins`."""
