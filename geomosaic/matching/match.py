"""One pair of frames: about where it is expected to match first, over all of both images where that fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from geomosaic.arrays import Floats, Floats32, Ints, Ints32
from geomosaic.constants import tuned
from geomosaic.matching.features import Features, coarsest
from geomosaic.matching.planes import Guess, plane_through, through
from geomosaic.matching.search import CHECKS, PlacedKeypoints, root_sift, search

_FREE_LEAST = tuned(1.5, "least numbers", "of a free search: less ties by chance; more leaves frames loose")
_FEW = tuned(1200, "keypoints", "coarsest, tried first: fewer miss small overlaps; more are slow")
_TOLERANCES = tuned(12.0, "tolerances", "least search radius: less defeats the ratio test; more takes time")
_SPREAD = tuned(3.0, "90 % residuals", "search radius: less cuts off hills; more compares other ground")


@dataclass(frozen=True)
class Matching:
    """How pairs are matched.

    ratio: Lowe's. check: one of CHECKS, with its tolerance in pixels of the images that keypoints are of.
    least: fewest tie points of a pair. search: where keypoints are compared. `coarse`: the coarsest first,
    about the guess, then everywhere, and all about what they show. `near`: all about the guess. `all`: all
    about the guess, then all everywhere, a quarter of a second a pair.
    """

    ratio: float
    check: str
    tolerance_px: float
    least: int
    search: Literal["coarse", "near", "all"] = "coarse"


@dataclass(frozen=True)
class PairMatch:
    """Keypoint numbers of the tie points; empty if the pair doesn't hold together. `free`: found
    against the guess, over the whole of both frames. keypoints: of both frames. alike, agreeing: the most
    matches that a search brought, and that passed the geometric check."""

    left: Ints32
    right: Ints32
    free: bool
    keypoints: tuple[int, int] = (0, 0)
    alike: int = 0
    agreeing: int = 0

    def why_not(self, least: int) -> str:
        """Why the pair isn't tied; empty if it is."""
        if len(self.left):
            return ""
        if min(self.keypoints) < least:
            return f"too few keypoints: {self.keypoints[0]} and {self.keypoints[1]}"
        if self.alike < least:
            return f"too few look alike: {self.alike}, {least} are needed"
        free = int(_FREE_LEAST * least)
        wanted = least if self.agreeing < least else free
        return f"too few agree: {self.agreeing} of {self.alike}, {wanted} are needed"


@dataclass(frozen=True)
class MatchKeypoints:
    """A frame's keypoints as pairs compare them: image_px (n, 2) in the full frame, root (n, 128) as
    `root_sift` gives them, numbers of the coarsest few."""

    image_px: Floats
    root: Floats32
    few: Ints

    @classmethod
    def of(cls, features: Features) -> MatchKeypoints:
        """Of keypoints as SIFT gives them."""
        return cls(features.image_px, root_sift(features.descriptors), coarsest(features, _FEW))

    @property
    def nbytes(self) -> int:
        """What it holds."""
        return self.image_px.nbytes + self.root.nbytes + self.few.nbytes


def match_pair(
    how: Matching, left: MatchKeypoints, right: MatchKeypoints, guess: Guess, pixel_px: float
) -> PairMatch:
    """Tie points of a pair: search, one-to-one, geometric check, at least `least` of them.

    A free search, which nothing but the image supports, must bring half as many again.

    Args: pixel_px: of the images that keypoints are of, in pixels of the frames.
    """
    pair = _Pair(how, left, right, how.tolerance_px * pixel_px)
    for way, free in _WAYS[how.search]:
        if free or np.isfinite(guess.radius_px):
            at, radius_px = (
                (left.image_px, np.inf) if free else (through(guess.plane, left.image_px), guess.radius_px)
            )
            i, j = pair.agreeing(*way(pair, at, radius_px))
            i, j = _once_per_place(left.image_px[i], right.image_px[j], i, j)
            if len(i) >= int((_FREE_LEAST if free else 1.0) * how.least):
                return PairMatch(i.astype(np.int32), j.astype(np.int32), free, *pair.looked())
    nothing = np.zeros(0, np.int32)
    return PairMatch(nothing, nothing, False, *pair.looked())


class _Pair:
    """Two frames' keypoints and what they look like."""

    def __init__(
        self, how: Matching, left: MatchKeypoints, right: MatchKeypoints, tolerance_px: float
    ) -> None:
        self.how, self.tolerance_px = how, tolerance_px
        self.left_px, self.right_px = left.image_px, right.image_px
        self.left, self.right = left.root, PlacedKeypoints(right.root, right.image_px)
        self.few = left.few, right.few
        self._alike, self._agreeing = 0, 0

    def looked(self) -> tuple[tuple[int, int], int, int]:
        """Keypoints of both, most that looked alike in a search, most that agreed."""
        return (len(self.left_px), len(self.right_px)), self._alike, self._agreeing

    def searched(self, at: Floats, radius_px: float) -> tuple[Ints, Ints]:
        """All keypoints, each about where it is expected in the right image."""
        return search(PlacedKeypoints(self.left, at), self.right, radius_px, self.how.ratio)

    def agreeing(self, i: Ints, j: Ints) -> tuple[Ints, Ints]:
        """Those that pass the geometric check together."""
        good = CHECKS[self.how.check](self.left_px[i], self.right_px[j], self.tolerance_px)
        self._alike, self._agreeing = max(self._alike, len(i)), max(self._agreeing, int(good.sum()))
        return i[good], j[good]

    def coarse_to_fine(self, at: Floats, radius_px: float) -> tuple[Ints, Ints]:
        """The coarsest keypoints say where in the right image the left one lies, and the rest is compared
        about there; nothing where they don't say it."""
        few_i, few_j = self.few
        left = PlacedKeypoints(self.left, at).of(few_i)
        i, j = search(left, self.right.of(few_j), radius_px, self.how.ratio)
        i, j = self.agreeing(few_i[i], few_j[j])
        plane = plane_through(self.left_px[i], self.right_px[j]) if len(i) >= self.how.least else None
        if plane is None:
            return few_i[:0], few_j[:0]
        at = through(plane, self.left_px)
        off_px = np.linalg.norm(at[i] - self.right_px[j], axis=1)
        radius_px = max(_TOLERANCES * self.tolerance_px, _SPREAD * float(np.quantile(off_px, 0.9)))
        return self.searched(at, radius_px)


_WAYS: dict[str, tuple[tuple[Callable[[_Pair, Floats, float], tuple[Ints, Ints]], bool], ...]] = {
    "coarse": ((_Pair.coarse_to_fine, False), (_Pair.coarse_to_fine, True)),
    "near": ((_Pair.searched, False),),
    "all": ((_Pair.searched, False), (_Pair.searched, True)),
}


def _once_per_place(left_px: Floats, right_px: Floats, i: Ints, j: Ints) -> tuple[Ints, Ints]:
    """SIFT gives one place several orientations; count it once."""
    _, first = np.unique(np.concatenate([left_px, right_px], axis=1).round(1), axis=0, return_index=True)
    first.sort()
    return i[first], j[first]
