"""Which frames see which points, in order of frames, and what follows from that alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.dissected import Dissection
from geomosaic.constants import CHOSEN, Because

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
AT_ONCE: Annotated[
    int,
    Because(
        "image observations",
        "linearised at once, whole frames of them: their derivatives (1 to 2 MB) stay in the processor's "
        "cache; fewer mean more calls, more go through the memory",
        CHOSEN,
    ),
] = 4096


@dataclass(frozen=True)
class Batch:
    """Sightings of frames `first` to `last`, without the last: a span of all.

    met (q,): the points they see, each once for each camera, as camera times the number of points plus point;
    which (n,): that of each sighting, as its place in met.
    """

    first: int
    last: int
    span: slice
    met: Ints
    which: Ints

    def summed(self, values: Floats) -> Floats:
        """What sightings say (k, n), added up for each of `met`, (q, k)."""
        return np.stack([np.bincount(self.which, row, len(self.met)) for row in values], axis=1)


@dataclass(frozen=True)
class SharedPoints:
    """Pairs of frames and the points that both see.

    left, right (k,): frames, left < right, sorted. starts (k + 1,): of each pair's share of one and other
    (n,), sightings of the same point from the left frame and from the right one.
    """

    frames: int
    left: Ints
    right: Ints
    starts: Ints
    one: Ints
    other: Ints

    @cached_property
    def matrix(self) -> tuple[Ints, Ints, Ints]:
        """Columns and row starts of a matrix of frames that has a block for each frame and, on both sides of
        its diagonal, for each pair; and the blocks' places, frames before pairs before pairs turned over."""
        f = self.frames
        row = np.concatenate([np.arange(f), self.left, self.right])
        column = np.concatenate([np.arange(f), self.right, self.left])
        order = np.lexsort((column, row))
        starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=f))])
        return column[order], starts, order

    def spans(self) -> Iterator[tuple[int, int]]:
        """Runs of pairs with as few points as `Sightings.spans` has sightings."""
        return _runs(self.starts)

    @cached_property
    def dissection(self) -> Dissection:
        """In which order such a matrix is factorised."""
        columns, starts, _ = self.matrix
        return Dissection.of(columns, starts)


@dataclass(frozen=True)
class Sightings:
    """m sightings of points by frames, sorted by frame, those of a frame as they came.

    order (m,): the place of each before it was sorted. frame, point (m,): numbers below frames and points.
    """

    frames: int
    points: int
    order: Ints
    frame: Ints
    point: Ints
    _batches: dict[bytes, list[Batch]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, frame: Ints, point: Ints, frames: int, points: int) -> Sightings:
        """From frame and point of each, in any order."""
        order = np.argsort(frame, kind="stable")
        return cls(frames, points, order, frame[order], point[order])

    @cached_property
    def starts(self) -> Ints:
        """Where each frame's sightings begin, and the end, (frames + 1,)."""
        return np.searchsorted(self.frame, np.arange(self.frames + 1))

    def spans(self) -> Iterator[tuple[int, int]]:
        """Runs of frames with few enough sightings for their derivatives to stay in the processor's cache."""
        return _runs(self.starts)

    def batches(self, camera_of: Ints) -> list[Batch]:
        """All sightings, some frames at a time. camera_of (frames,)."""
        key = camera_of.tobytes()
        if key not in self._batches:
            self._batches[key] = [self._batch(first, last, camera_of) for first, last in self.spans()]
        return self._batches[key]

    def _batch(self, first: int, last: int, camera_of: Ints) -> Batch:
        span = slice(int(self.starts[first]), int(self.starts[last]))
        numbers = camera_of[self.frame[span]] * self.points + self.point[span]
        met, which = np.unique(numbers, return_inverse=True)
        return Batch(first, last, span, met, which)

    @cached_property
    def shared_points(self) -> SharedPoints:
        """By pairs of frames."""
        by_point = np.argsort(self.point, kind="stable")
        point, one, other = self.point[by_point], [], []
        for step in range(1, len(point)):
            same = np.flatnonzero(point[step:] == point[:-step])
            if not len(same):
                break
            one.append(by_point[same])
            other.append(by_point[same + step])
        first = np.concatenate([np.zeros(0, np.intp), *one])
        second = np.concatenate([np.zeros(0, np.intp), *other])
        pair = self.frame[first] * self.frames + self.frame[second]
        order = np.argsort(pair, kind="stable")
        names, starts = np.unique(pair[order], return_index=True)
        left, right = np.divmod(names, self.frames)
        starts = np.append(starts, len(pair))
        return SharedPoints(self.frames, left, right, starts, first[order], second[order])


def _runs(starts: Ints) -> Iterator[tuple[int, int]]:
    first, last = 0, len(starts) - 1
    while first < last:
        end = int(np.searchsorted(starts, starts[first] + AT_ONCE, side="right")) - 1
        end = max(end, first + 1)
        yield first, end
        first = end
