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
class Joined:
    """The n keypoints of all tie points, in the order of frames and keypoint numbers.

    frame, track: (n,) indices. image_px: (n, 2). ends: for each pair of frames, (2, k) numbers of its tie
    points' keypoints among the n, left and right. once: (n,) whether its track sees no frame twice.
    """

    frame: Ints
    track: Ints
    image_px: Floats
    ends: tuple[Ints, ...]
    once: NDArray[np.bool_]

    @property
    def degree(self) -> Ints:
        """In how many tie points each keypoint stands, (n,)."""
        return np.bincount(np.concatenate([e.ravel() for e in self.ends]), minlength=len(self.frame))


def join(pairs: Sequence[TiePair]) -> Joined:
    """Keypoints that are connected by tie points, however far, are of one track."""
    if not sum(map(len, pairs)):
        none = np.zeros(0, np.intp)
        ends = tuple(np.zeros((2, 0), np.intp) for _ in pairs)
        return Joined(none, none, np.zeros((0, 2)), ends, np.zeros(0, np.bool_))
    frames = np.concatenate([np.repeat([[t.left], [t.right]], len(t), axis=1) for t in pairs], axis=1)
    features = np.concatenate([np.stack([t.left_feature, t.right_feature]) for t in pairs], axis=1)
    px = np.concatenate([np.stack([t.left_px, t.right_px]) for t in pairs], axis=1)
    keys = frames.astype(np.int64) * (int(features.max()) + 1) + features
    names, first, number = np.unique(keys.ravel(), return_index=True, return_inverse=True)
    number = number.reshape(keys.shape)
    graph = coo_matrix((np.ones(number.shape[1], np.int8), (number[0], number[1])), shape=(len(names),) * 2)
    _, track = connected_components(graph, directed=False)
    frame = frames.ravel()[first]
    order = np.lexsort((frame, track))
    twice = (np.diff(track[order]) == 0) & (np.diff(frame[order]) == 0)
    once = ~np.isin(track, track[order][1:][twice])
    ends = tuple(np.split(number, np.cumsum([len(t) for t in pairs])[:-1], axis=1))
    return Joined(frame.astype(np.intp), track.astype(np.intp), px.reshape(-1, 2)[first], ends, once)


def references(joined: Joined, sizes_px: Floats) -> Ints:
    """For each keypoint the one of its track that stands for the place on the ground, (n,): that with most
    tie points, of those the nearest to its frame's middle, where the ground is seen most from above.

    Args: sizes_px (frames, 2): width and height of each frame.
    """
    aside = np.linalg.norm(joined.image_px / sizes_px[joined.frame] - 0.5, axis=1)
    order = np.lexsort((aside, -joined.degree, joined.track))
    first = np.diff(joined.track[order], prepend=-1) != 0
    return np.asarray(order[first][joined.track], np.intp)
