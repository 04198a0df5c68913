"""Keypoints that tie points join: one place on the ground, seen in two or more frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from geomosaic.matching.model import TiePair

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class Keypoints:
    """The n keypoints of all tie points, each once, in the order of frames and their numbers.

    frame (n,): indices. image_px (n, 2). ends: for each pair of frames, (2, k) numbers of its tie points'
    keypoints among the n, left and right.
    """

    frame: Ints
    image_px: Floats
    ends: tuple[NDArray[np.int32], ...]

    @classmethod
    def of(cls, pairs: Sequence[TiePair]) -> Keypoints:
        """Frame by frame, so that nothing is ever made of all tie points but these numbers."""
        ends = tuple(np.empty((2, len(t)), np.int32) for t in pairs)
        sides: dict[int, list[tuple[NDArray[np.int32], Floats, NDArray[np.int32]]]] = {}
        for t, (left, _) in zip(pairs, ends, strict=True):
            sides.setdefault(t.left, []).append((t.left_feature, t.left_px, left))
        for t, (_, right) in zip(pairs, ends, strict=True):
            sides.setdefault(t.right, []).append((t.right_feature, t.right_px, right))
        count, frames, image_px = 0, [np.zeros(0, np.intp)], [np.zeros((0, 2))]
        for frame in sorted(sides):
            features, places, numbers = zip(*sides[frame], strict=True)
            _, first, number = np.unique(np.concatenate(features), return_index=True, return_inverse=True)
            bounds = np.cumsum([len(one) for one in features])[:-1]
            for into, some in zip(numbers, np.split(number, bounds), strict=True):
                into[:] = count + some
            frames.append(np.full(len(first), frame, np.intp))
            image_px.append(np.concatenate(places)[first])
            count += len(first)
        return cls(np.concatenate(frames), np.concatenate(image_px), ends)


@dataclass(frozen=True)
class Joined(Keypoints):
    """Keypoints and the tracks they belong to: track (n,), once (n,): whether it sees no frame twice."""

    track: Ints
    once: NDArray[np.bool_]

    @property
    def degree(self) -> Ints:
        """In how many tie points each keypoint stands, (n,)."""
        out = np.zeros(len(self.frame), np.intp)
        for numbers in self.ends:
            out += np.bincount(numbers.ravel(), minlength=len(out))
        return out


def join(pairs: Sequence[TiePair]) -> Joined:
    """Keypoints that are connected by tie points, however far, are of one track."""
    all_of = Keypoints.of(pairs)
    n = len(all_of.frame)
    left, right = np.concatenate([np.zeros((2, 0), np.int32), *all_of.ends], axis=1)
    graph = coo_matrix((np.ones(len(left), np.int8), (left, right)), shape=(n, n))
    count, track = connected_components(graph, directed=False)
    order = np.lexsort((all_of.frame, track))
    twice = (np.diff(track[order]) == 0) & (np.diff(all_of.frame[order]) == 0)
    once = np.ones(count, np.bool_)
    once[track[order[1:]][twice]] = False
    return Joined(all_of.frame, all_of.image_px, all_of.ends, track.astype(np.intp), once[track])


def references(joined: Joined, sizes_px: Floats) -> Ints:
    """For each keypoint the one of its track that stands for the place on the ground, (n,): that with most
    tie points, of those the nearest to its frame's middle, where the ground is seen most from above.

    Args: sizes_px (frames, 2): width and height of each frame.
    """
    aside = np.linalg.norm(joined.image_px / sizes_px[joined.frame] - 0.5, axis=1)
    order = np.lexsort((aside, -joined.degree, joined.track))
    first = np.diff(joined.track[order], prepend=-1) != 0
    return np.asarray(order[first][joined.track], np.intp)
