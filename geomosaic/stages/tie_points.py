"""Pairs of frames matched in rounds, and their tie points moved: what matching spreads over the workers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.matching.features import Features
from geomosaic.matching.match import Matching, PairMatch
from geomosaic.matching.model import TiePairs, TiePoints
from geomosaic.matching.planes import Guess, SeenPlanes
from geomosaic.matching.refinement import Refinement
from geomosaic.matching.tracks import MOST_TIED, thin_pairs
from geomosaic.matching.untied import untied_reasons
from geomosaic.pipeline.stage import Context
from geomosaic.pipeline.stored_result import StoredResult
from geomosaic.placement.graph import adjacent_frames, connected_parts
from geomosaic.stages.keypoints import (
    PairItem,
    Picture,
    PlacesAsked,
    Search,
    Sought,
    frame_places,
    frame_windows,
    pair_match,
)

Pair = tuple[int, int]


@dataclass
class Pairing:
    """The pairs of a survey, matched where it costs least first.

    expected: where a pair is expected to match. pixel_px: of each frame, its pixels in one of the image
    that keypoints are of. sequence: frames in order of flight.
    """

    context: Context
    how: Matching
    features: Sequence[StoredResult[Features]]
    sizes_px: Sequence[Pair]
    pixel_px: Sequence[float]
    expected: Callable[[int, int], Guess]
    sequence: Sequence[int]
    looks: dict[Pair, PairMatch] = field(default_factory=dict)
    _planes: SeenPlanes = field(init=False)

    def __post_init__(self) -> None:
        self._planes = SeenPlanes(self._tie_points)

    def match(self, pairs: Iterable[Pair]) -> TiePairs:
        """The pairs that tie points connect. Each is matched about where it is expected to match, then where
        its neighbours show that it should. Last, frames that are still connected to no others are matched by
        all keypoints."""
        pairs = list(pairs)
        self._round("pairs", self.how, [(p, self.expected(*p)) for p in pairs])
        self._by_neighbours()
        apart = self._apart()
        if apart:
            said = [(p, self.expected(*p)) for p in apart]
            self._round("pairs of untied frames", replace(self.how, search="all"), said)
            self._by_neighbours()
        return self._found()

    @property
    def tied(self) -> list[Pair]:
        """Pairs that hold together."""
        return [pair for pair, match in self.looks.items() if len(match.left)]

    @property
    def untied(self) -> list[Pair]:
        """Pairs that were tried in vain."""
        return [pair for pair, match in self.looks.items() if not len(match.left)]

    def ties(self, pairs: TiePairs, faint: Sequence[float]) -> TiePoints:
        """Tied pairs, untied ones, and why frames have no tie. faint: share of each frame's tiles."""
        reasons = untied_reasons(self.looks, self._counts(), faint, self.how.least)
        return TiePoints(pairs, tuple(self.untied), reasons)

    def _found(self) -> TiePairs:
        """All pairs that hold together now, by keypoints that any of them has."""
        tied = self.tied
        counts = np.array([len(self.looks[pair].left) for pair in tied], dtype=np.int32)
        first = np.concatenate([[0], np.cumsum(self._counts())]).astype(np.int32)
        keypoints, at = np.empty((2, int(counts.sum())), dtype=np.int32), 0
        for (a, b), count in zip(tied, counts.tolist(), strict=True):
            match = self.looks[a, b]
            keypoints[:, at : at + count] = first[a] + match.left, first[b] + match.right
            at += count
        used = np.zeros(first[-1], dtype=bool)
        used[keypoints] = True
        frame = np.repeat(np.arange(len(self.features), dtype=np.int32), np.diff(first))[used]
        image_px, at = np.empty((len(frame), 2)), 0
        for i, mine in enumerate(np.split(used, first[1:-1])):
            some = self._places_of(i)[mine]
            image_px[at : at + len(some)] = some
            at += len(some)
        number = np.cumsum(used, dtype=np.int32) - np.int32(1)
        pairs = np.array(tied, dtype=np.int32).reshape(-1, 2)
        of_tied = TiePairs(frame, image_px, pairs, counts, number[keypoints])
        return thin_pairs(of_tied, np.array(self.sizes_px, np.float64), self.how.least, MOST_TIED)

    def _counts(self) -> list[int]:
        """How many keypoints each frame has."""
        return [len(self._places_of(i)) for i in range(len(self.features))]

    def _by_neighbours(self) -> None:
        """Untied pairs of which common neighbours say where they match, as long as that brings more."""
        asked: set[Pair] = set()
        while True:
            waiting = [pair for pair in self.untied if pair not in asked]
            guesses = [(pair, self._planes.guess(*pair, self.sizes_px)) for pair in waiting]
            said = [(pair, guess) for pair, guess in guesses if guess is not None]
            asked |= {pair for pair, _ in said}
            if not said or not self._round("pairs by neighbours", replace(self.how, search="near"), said):
                return

    def _apart(self) -> list[Pair]:
        """Untied pairs of frames that aren't connected, and of untied frames those flown next to them."""
        tied = self.tied
        part: dict[int, int] = {}
        for k, members in enumerate(connected_parts(len(self.features), tied)):
            part |= dict.fromkeys(members, k)
        untied = set(range(len(self.features))) - {i for pair in tied for i in pair}
        return [
            *[(a, b) for a, b in self.untied if part[a] != part[b]],
            *adjacent_frames(untied, self.sequence, list(self.looks)),
        ]

    def _round(self, name: str, how: Matching, pairs: Sequence[tuple[Pair, Guess]]) -> int:
        """How many of some pairs hold together now."""
        items = [
            PairItem(self.features[a], self.features[b], guess, max(self.pixel_px[a], self.pixel_px[b]))
            for (a, b), guess in pairs
        ]
        found = self.context.map(name, partial(pair_match, how), items)
        tied = 0
        for ((a, b), _), match in zip(pairs, found, strict=True):
            self.looks[a, b] = match
            if len(match.left):
                self._planes.add(a, b, len(match.left))
                tied += 1
        return tied

    def _tie_points(self, a: int, b: int) -> tuple[Floats, Floats]:
        """Of a pair as it is now, in the left and the right frame."""
        match = self.looks[a, b]
        return self._places_of(a)[match.left], self._places_of(b)[match.right]

    def _places_of(self, frame: int) -> Floats:
        """In its file, which stays open as long as this is in use."""
        return self.features[frame].look().image_px


def record_tried(
    context: Context, names: Sequence[str], pairing: Pairing, pairs: TiePairs, least: int
) -> None:
    """Every pair that was tried: what was found of it, and why it isn't tied."""
    points = dict(zip(map(tuple, pairs.frames.tolist()), pairs.counts.tolist(), strict=True))
    looks = pairing.looks
    context.recorder.table(
        "pairs.tried",
        [names[a] for a, _ in looks],
        {
            "left_keypoints": [m.keypoints[0] for m in looks.values()],
            "right_keypoints": [m.keypoints[1] for m in looks.values()],
            "raw_matches": [m.alike for m in looks.values()],
            "inliers": [m.agreeing for m in looks.values()],
            "tie_points": [points.get(pair, 0) for pair in looks],
        },
        others=[names[b] for _, b in looks],
        notes=[m.why_not(least) for m in looks.values()],
    )


def refined(
    context: Context,
    pictures: Sequence[Picture],
    sizes_px: Sequence[Pair],
    pairs: TiePairs,
    least: int,
) -> TiePairs:
    """Tie points moved to where windows about them agree in the pixels; two passes over the frames: what each
    shows to others, and where it shows what others do."""
    if not pairs:
        return pairs
    todo = Refinement.of(pairs, sizes_px)
    px = todo.joined.image_px
    shown = [
        PlacesAsked(picture, px[keypoints]) for picture, keypoints in zip(pictures, todo.shown, strict=True)
    ]
    windows = context.stored("surroundings of tie points", frame_windows, shown)
    searches = {}
    for i, sought in enumerate(todo.sought):
        parts = [
            Sought(windows[s.of], pictures[s.of].reduction, s.rows, px[s.keypoints], s.shapes) for s in sought
        ]
        if parts:
            searches[i] = Search(pictures[i], tuple(parts))
    places = context.map("tie points in the pixels", frame_places, searches.values())
    found = {i: (p.image_px, p.sure) for i, p in zip(searches, places, strict=True)}
    del searches, places
    return todo.applied(found, least)
