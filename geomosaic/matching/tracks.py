"""Keypoints that tie points join: one place on the ground, seen in two or more frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from geomosaic.matching.model import TiePair, TiePairs

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Joined(TiePairs):
    """Pairs and the tracks that their keypoints belong to: track (n,), once (n,): whether it sees no frame
    twice."""

    track: Ints
    once: NDArray[np.bool_]

    @property
    def degree(self) -> Ints:
        """In how many tie points each keypoint stands, (n,)."""
        return np.bincount(self.keypoints.ravel(), minlength=len(self.frame))


def join(pairs: Sequence[TiePair]) -> Joined:
    """Keypoints that are connected by tie points, however far, are of one track."""
    all_of = TiePairs.of(pairs)
    n = len(all_of.frame)
    ones = np.ones(all_of.keypoints.shape[1], np.int8)
    graph = coo_matrix((ones, tuple(all_of.keypoints)), shape=(n, n))
    count, track = connected_components(graph, directed=False)
    order = np.lexsort((all_of.frame, track))
    twice = (np.diff(track[order]) == 0) & (np.diff(all_of.frame[order]) == 0)
    once = np.ones(count, np.bool_)
    once[track[order[1:]][twice]] = False
    return Joined(
        *(all_of.frame, all_of.image_px, all_of.frames, all_of.counts, all_of.keypoints),
        track=track.astype(np.intp),
        once=once[track],
    )


def references(joined: Joined, sizes_px: Floats) -> Ints:
    """For each keypoint the one of its track that stands for the place on the ground, (n,): that with most
    tie points, of those the nearest to its frame's middle, where the ground is seen most from above.

    Args: sizes_px (frames, 2): width and height of each frame.
    """
    aside = np.linalg.norm(joined.image_px / sizes_px[joined.frame] - 0.5, axis=1)
    order = np.lexsort((aside, -joined.degree, joined.track))
    first = np.diff(joined.track[order], prepend=-1) != 0
    return np.asarray(order[first][joined.track], np.intp)
