"""Tie points of matched keypoints, refined to where the pixels agree.

Each track has one frame that stands for the place on the ground; what that frame shows there is sought in the
track's other frames. Keypoints move, not pairs: so a track stays one place however many pairs see it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.matching.model import TiePair, TiePairs
from geomosaic.matching.planes import SeenPlanes, stretched
from geomosaic.matching.tracks import Joined, join, references


@dataclass(frozen=True)
class SoughtIn:
    """What of one frame is sought in another. rows (n,): of that frame's windows. keypoints (n,): to be
    moved. shapes (n, 2, 2): how the plane between both frames turns and stretches windows about them."""

    of: int
    rows: Ints
    keypoints: Ints
    shapes: Floats


@dataclass(frozen=True)
class Refinement:
    """What is to be looked for where.

    shown: of each frame the keypoints whose surroundings stand for their tracks. sought: of each frame what
    is looked for in it, frame by frame.
    """

    joined: Joined
    shown: tuple[Ints, ...]
    sought: tuple[tuple[SoughtIn, ...], ...]

    @classmethod
    def of(cls, pairs: Sequence[TiePair], sizes_px: Sequence[tuple[int, int]]) -> Refinement:
        """Args: pairs, in any order; sizes_px: width and height of each frame."""
        joined, n = join(pairs), len(sizes_px)
        standing = references(joined, np.array(sizes_px, np.float64))
        planes = _planes(TiePairs.of(pairs))
        own = np.arange(len(standing))
        stand = np.flatnonzero((standing == own) & joined.once)
        shown = np.split(stand, np.searchsorted(joined.frame[stand], np.arange(1, n)))
        row = np.zeros(len(standing), np.intp)
        for keypoints in shown:
            row[keypoints] = np.arange(len(keypoints))
        moved = np.flatnonzero((standing != own) & joined.once)
        here, there = joined.frame[moved], joined.frame[standing[moved]]
        order = np.lexsort((moved, there, here))
        changes = np.flatnonzero((np.diff(here[order]) != 0) | (np.diff(there[order]) != 0)) + 1
        sought: list[list[SoughtIn]] = [[] for _ in range(n)]
        for some in np.split(order, changes) if len(order) else ():
            a, b = int(there[some[0]]), int(here[some[0]])
            plane = planes.between(a, b)
            if plane is not None:
                keypoints = moved[some]
                middles = joined.image_px[standing[keypoints]]
                sought[b].append(SoughtIn(a, row[standing[keypoints]], keypoints, stretched(plane, middles)))
        return cls(joined, tuple(shown), tuple(map(tuple, sought)))

    def applied(self, found: Mapping[int, tuple[Floats, Bools]], least: int) -> TiePairs:
        """The tie points where pixels agree; a pair that would keep fewer than `least` keeps all it had,
        where they were.

        Args: found: by frame, places and whether they are sure, as in `sought`.
        """
        px = self.joined.image_px.copy()
        sure = np.zeros(len(px), np.bool_)
        sure[np.concatenate(self.shown)] = True
        for frame, (places, good) in found.items():
            keypoints = np.concatenate([s.keypoints for s in self.sought[frame]])
            px[keypoints[good]] = places[good]
            sure[keypoints[good]] = True
        return self.joined.thinned(sure, px, least)


def _planes(pairs: TiePairs) -> SeenPlanes:
    """The planes of all pairs."""
    frames = [(int(a), int(b)) for a, b in pairs.frames]
    number = {pair: k for k, pair in enumerate(frames)}

    def places(left: int, right: int) -> tuple[Floats, Floats]:
        t = pairs[number[left, right]]
        return t.left_px, t.right_px

    planes = SeenPlanes(places)
    for pair, count in zip(frames, pairs.counts.tolist(), strict=True):
        planes.add(*pair, count)
    return planes
