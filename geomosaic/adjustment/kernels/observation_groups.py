"""Which frames see which points, a group of points after the other, and what follows from that alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Ints
from geomosaic.constants import tuned
from geomosaic.estimation.nested_dissection import Dissection, matrix_of_pairs

Numbers = NDArray[np.int32]
AT_ONCE = tuned(8192, "image observations", "linearised at once; fewer: more calls; more leave the cache")
_PAIRS_AT_ONCE = tuned(1024, "pairs of observations", "multiplied at once; more leave the cache")


@dataclass(frozen=True)
class Group:
    """Consecutive points and all n sightings of them, in order of frames; spans of all.

    frames (r,), runs (r + 1,): those that observe any, and where each one's sightings begin. pairs (q,):
    pairs of frames that share points, rising by how many; batches (b + 1,): where each batch of pairs begins.
    one, other: places of sightings of a point from the left and the right frame, equally many for each pair
    of a batch (fewer are filled with the place n). shared (b + 1,): where each batch begins among these.
    """

    points: slice
    span: slice
    frames: Ints
    runs: Ints
    pairs: Ints
    shared: Ints
    batches: Ints
    one: Numbers
    other: Numbers

    @property
    def size(self) -> int:
        """How many points there are."""
        return int(self.points.stop - self.points.start)


@dataclass(frozen=True)
class Sightings:
    """m sightings of points by frames, sorted by groups of points and then by frame. order (m,): the place of
    each before it was sorted. frame, point (m,): numbers below frames and points. left, right (k,): pairs of
    frames that share points, left < right, sorted."""

    frames: int
    points: int
    order: Numbers
    frame: Numbers
    point: Numbers
    groups: tuple[Group, ...]
    left: Ints
    right: Ints

    @classmethod
    def of(cls, frame: Ints, point: Ints, frames: int, points: int) -> Sightings:
        """From frame and point of each, in any order."""
        starts = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=points))])
        bounds = list(_bounds(starts))
        group_of = np.repeat(np.arange(len(bounds), dtype=np.int32), [last - first for first, last in bounds])
        order: Numbers = np.lexsort((frame, group_of[point])).astype(np.int32)
        seen_by: Numbers = frame[order].astype(np.int32)
        seen: Numbers = point[order].astype(np.int32)
        groups = [
            _group(slice(first, last), slice(int(starts[first]), int(starts[last])), seen_by, seen, frames)
            for first, last in bounds
        ]
        names = np.unique(np.concatenate([np.zeros(0, np.intp), *(group.pairs for group in groups)]))
        numbered = (replace(group, pairs=np.searchsorted(names, group.pairs)) for group in groups)
        return cls(frames, points, order, seen_by, seen, tuple(numbered), *np.divmod(names, frames))

    @cached_property
    def matrix(self) -> tuple[Ints, Ints, Ints]:
        """See `matrix_of_pairs`."""
        return matrix_of_pairs(self.frames, self.left, self.right)

    @cached_property
    def dissection(self) -> Dissection:
        """In which order such a matrix is factorised."""
        columns, starts, _ = self.matrix
        return Dissection.of(columns, starts)


def _bounds(starts: Ints) -> Iterator[tuple[int, int]]:
    """First and last point of each group, without the last."""
    first, last = 0, len(starts) - 1
    while first < last:
        end = int(np.searchsorted(starts, starts[first] + AT_ONCE, side="right")) - 1
        end = max(end, first + 1)
        yield first, end
        first = end


def _group(points: slice, span: slice, frame: Numbers, point: Numbers, frames: int) -> Group:
    """Pairs are named left times the number of frames plus right."""
    frame, point = frame[span], point[span]
    seen, runs = np.unique(frame, return_index=True)
    by_point = np.argsort(point, kind="stable")
    in_turn, one, other = point[by_point], [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
    for step in range(1, len(point)):
        same = np.flatnonzero(in_turn[step:] == in_turn[:-step])
        if not len(same):
            break
        one.append(by_point[same])
        other.append(by_point[same + step])
    first, second = np.concatenate(one), np.concatenate(other)
    pair = frame[first].astype(np.intp) * frames + frame[second]
    order = np.argsort(pair, kind="stable")
    pairs, begin, counts = np.unique(pair[order], return_index=True, return_counts=True)
    by_count = np.argsort(counts, kind="stable")
    counts = counts[by_count]
    batches = _batches(counts)
    width = np.repeat(counts[batches[1:] - 1], np.diff(batches))
    ends = np.cumsum(width)
    within = np.arange(len(pair)) - np.repeat(np.cumsum(counts) - counts, counts)
    order = order[within + np.repeat(begin[by_count], counts)]
    filled = within + np.repeat(ends - width, counts)
    places = np.full((2, int(width.sum())), len(point), dtype=np.int32)
    places[:, filled] = first[order], second[order]
    return Group(
        points,
        span,
        seen.astype(np.intp),
        np.append(runs, len(frame)),
        pairs[by_count],
        np.append(0, ends)[batches],
        batches,
        *places,
    )


def _batches(counts: Ints) -> Ints:
    """Where batches of pairs of rising counts begin, and the end."""
    bounds = [0]
    while bounds[-1] < len(counts):
        padded = counts[bounds[-1] :] * np.arange(1, len(counts) - bounds[-1] + 1)
        bounds.append(bounds[-1] + max(int(np.searchsorted(padded, _PAIRS_AT_ONCE, side="right")), 1))
    return np.array(bounds, dtype=np.intp)
