"""Tie points: what matching gives and adjustment takes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import overload

import numpy as np

from geomosaic.arrays import Bools, Floats, Ints, Ints32


@dataclass(frozen=True)
class TiePair:
    """Tie points of two frames. Indices are into `Survey.frames`; left < right.

    left_px, right_px: (k, 2) col and row in the full frames, GDAL's corner origin.
    left_feature, right_feature: (k,) keypoint numbers in each frame, so that pairs join to tracks.
    """

    left: int
    right: int
    left_px: Floats
    right_px: Floats
    left_feature: Ints32
    right_feature: Ints32

    def __len__(self) -> int:
        return len(self.left_px)


@dataclass(frozen=True, eq=False)
class TiePairs(Sequence[TiePair]):
    """Pairs of frames as pairs of keypoints, each with one place, however many pairs it stands in. They take
    a third of the memory of all `TiePair`, which are made when they are asked for.

    frame (n,), image_px (n, 2): the keypoints of all frames, in their order. frames (p, 2): left and right of
    each pair. counts (p,): its tie points. keypoints (2, m): which of the n, left and right, pair after pair.
    Raises: `ValueError` for keypoints that aren't there or not of the pair's frames.
    """

    frame: Ints32
    image_px: Floats
    frames: Ints32
    counts: Ints32
    keypoints: Ints32

    def __post_init__(self) -> None:
        n, pairs = len(self.frame), len(self.frames)
        numbers = (self.frame, self.frames, self.counts, self.keypoints)
        if any(a.dtype.kind != "i" or (a.size and a.min() < 0) for a in numbers):
            raise ValueError("tie points by what are no numbers")
        if self.frame.shape != (n,) or self.image_px.shape != (n, 2):
            raise ValueError("keypoints without a place")
        if self.frames.shape != (pairs, 2) or self.counts.shape != (pairs,):
            raise ValueError("pairs that aren't of two frames")
        if self.keypoints.shape != (2, int(self.counts.sum(dtype=np.int64))):
            raise ValueError("tie points that aren't of two keypoints")
        if self.keypoints.size and self.keypoints.max() >= n:
            raise ValueError("tie points of keypoints that aren't there")
        for frame, keypoints in zip(self.frames.T, self.keypoints, strict=True):
            if (self.frame[keypoints] != np.repeat(frame, self.counts)).any():
                raise ValueError("tie points of other frames' keypoints")

    @classmethod
    def of(cls, pairs: Sequence[TiePair]) -> TiePairs:
        """The same pairs, frame by frame, so that nothing else is ever made of all tie points. A keypoint
        that pairs place differently is where the first does."""
        if isinstance(pairs, TiePairs):
            return pairs
        counts = np.array([len(t) for t in pairs], dtype=np.int32)
        keypoints = np.empty((2, int(counts.sum())), dtype=np.int32)
        bounds = np.cumsum(counts)[:-1]
        sides: dict[int, list[tuple[Ints32, Floats, Ints32]]] = {}
        for t, into in zip(pairs, np.split(keypoints[0], bounds), strict=False):
            sides.setdefault(t.left, []).append((t.left_feature, t.left_px, into))
        for t, into in zip(pairs, np.split(keypoints[1], bounds), strict=False):
            sides.setdefault(t.right, []).append((t.right_feature, t.right_px, into))
        count, frame, image_px = 0, [np.zeros(0, np.int32)], [np.zeros((0, 2))]
        for i in sorted(sides):
            features, places, numbers = zip(*sides[i], strict=True)
            _, first, number = np.unique(np.concatenate(features), return_index=True, return_inverse=True)
            ends = np.cumsum([len(one) for one in features])[:-1]
            for into, some in zip(numbers, np.split(number, ends), strict=True):
                into[:] = count + some
            frame.append(np.full(len(first), i, np.int32))
            image_px.append(np.concatenate(places)[first])
            count += len(first)
        frames = np.array([(t.left, t.right) for t in pairs], dtype=np.int32).reshape(-1, 2)
        return cls(np.concatenate(frame), np.concatenate(image_px), frames, counts, keypoints)

    def part(self, kept: Bools, image_px: Floats) -> TiePairs:
        """Some of the tie points (m,) of all pairs, with keypoints (n, 2) elsewhere, those alone that they
        need."""
        keypoints = self.keypoints[:, kept]
        used = np.zeros(len(self.frame), dtype=bool)
        used[keypoints] = True
        number = np.cumsum(used, dtype=np.int32) - 1
        counts = np.diff(np.concatenate([[0], np.cumsum(kept)])[self.first]).astype(np.int32)
        return TiePairs(self.frame[used], image_px[used], self.frames, counts, number[keypoints])

    @cached_property
    def first(self) -> Ints:
        """Of each pair the first of its tie points, and how many there are in all, (p + 1,)."""
        return np.concatenate([[0], np.cumsum(self.counts, dtype=np.intp)])

    @property
    def ends(self) -> tuple[Ints32, ...]:
        """Of each pair the keypoints of its tie points, (2, k) of the n."""
        return tuple(self.keypoints[:, a:b] for a, b in itertools.pairwise(self.first.tolist()))

    def __len__(self) -> int:
        return len(self.frames)

    @overload
    def __getitem__(self, at: int) -> TiePair: ...

    @overload
    def __getitem__(self, at: slice) -> tuple[TiePair, ...]: ...

    def __getitem__(self, at: int | slice) -> TiePair | tuple[TiePair, ...]:
        if isinstance(at, slice):
            return tuple(self[i] for i in range(len(self))[at])
        k = range(len(self))[at]
        left, right = self.frames[k].tolist()
        i, j = self.keypoints[:, self.first[k] : self.first[k + 1]]
        return TiePair(left, right, self.image_px[i], self.image_px[j], i, j)


@dataclass(frozen=True)
class TiePoints:
    """All pairs that hold together; pairs tried without success are named in `untied`, frames without any tie
    in `reasons`, each with the reason."""

    pairs: tuple[TiePair, ...] | TiePairs
    untied: tuple[tuple[int, int], ...] = ()
    reasons: tuple[tuple[int, str], ...] = ()

    @property
    def frames(self) -> list[tuple[int, int]]:
        """Left and right of each pair."""
        if isinstance(self.pairs, TiePairs):
            return [(left, right) for left, right in self.pairs.frames.tolist()]
        return [(t.left, t.right) for t in self.pairs]
