"""Whether frames agree on a roof on its own heights, and nowhere about it less than on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats32
from geomosaic.composition.roof_views import RoofSeen
from geomosaic.constants import sourced, tuned
from geomosaic.surface.refinement import NOISE_GREY

_WINDOW = tuned(7, "px", "of correlation: larger mixes a roof with its yard; smaller is chance")
_ALIKE = sourced(0.5, "correlation", "of half a roof at least", "as much signal in both frames as noise")
_UNLIKE = tuned(0.3, "correlation", "of a place that frames do not agree on: noise reaches 0.3")
_MOST_UNLIKE = tuned(0.3, "share", "of a roof that frames do not agree on: less loses roofs with chimneys")
_WORSE = tuned(0.2, "correlation", "that a place loses: less is noise")
_MOST_WORSE = tuned(
    0.05, "share", "of places that lose, or of seams, or unseen: more cuts trees, leaves doubled edges"
)
_ABOUT = tuned(
    np.ones((21, 21), np.uint8), "px", "of a roof's yard: less is its shadow; more, the next house"
)
_SEAM = tuned(np.ones((11, 11), np.uint8), "px", "next to a roof: less is its edge; more lies beyond")
_INSIDE = np.ones((_WINDOW, _WINDOW), np.uint8)


@dataclass(frozen=True)
class RoofAgreement:
    """How well frames agree on a roof.

    on_roof, on_ground: median correlation of the roof between frames, on its heights and on the ground.
    unlike: share of the roof that frames do not agree on. worse: share of the roof and its surroundings that
    they agree on less than on the ground. seams: of the ground about the roof and about what it hides, where
    seams will lie, the share that they do not agree on. unseen: of what the roof hides from the steepest
    frame, the share that no other frame sees.
    """

    on_roof: float
    on_ground: float
    unlike: float
    worse: float
    seams: float
    unseen: float

    @property
    def likely(self) -> bool:
        """Whether frames agree on the roof on its heights, and not on the ground."""
        return self.on_roof >= _ALIKE > self.on_ground

    @property
    def raised(self) -> bool:
        """The same, on nearly all of it, and whether next to nothing about it is worse."""
        return (
            self.likely
            and self.unlike <= _MOST_UNLIKE
            and max(self.worse, self.seams, self.unseen) <= _MOST_WORSE
        )


def agreement(mask: Bools, seen: Sequence[RoofSeen], behind: Sequence[Bools]) -> RoofAgreement:
    """Of the steepest frame with each of the others, with the roof within a mask on its heights, and all else
    on the ground. behind: what it hides from each frame, by `Roof.hides`, which is not compared."""
    shown = [np.where(mask, of.on_roof, of.on_ground) for of in seen]
    clear = [(of > 0) & ~hidden for of, hidden in zip(shown, behind, strict=True)]
    ground = [of.on_ground for of in seen]
    raised = _median([_alike(shown[0], b, clear[0] & c) for b, c in zip(shown[1:], clear[1:], strict=True)])
    before = _median([_alike(ground[0], b, (ground[0] > 0) & (b > 0)) for b in ground[1:]])
    inner = cv2.erode(mask.astype(np.uint8), _INSIDE) > 0
    hidden = behind[0]
    taken = mask | hidden
    unseen = hidden & ~np.logical_or.reduce(clear[1:])
    seams = raised[(cv2.dilate(taken.astype(np.uint8), _SEAM) > 0) & ~taken & np.isfinite(raised)]
    own = raised[inner & np.isfinite(raised)]
    below = before[inner & np.isfinite(before)]
    both = np.isfinite(raised) & np.isfinite(before) & (cv2.dilate(mask.astype(np.uint8), _ABOUT) > 0)
    if not own.size or not below.size:
        return RoofAgreement(0.0, 0.0, 1.0, 1.0, 1.0, 1.0)
    return RoofAgreement(
        float(np.median(own)),
        float(np.median(below)),
        float(np.mean(own < _UNLIKE)),
        float(np.mean((raised < before - _WORSE)[both])),
        float(np.mean(seams < _UNLIKE)) if seams.size else 1.0,
        float(np.count_nonzero(unseen)) / max(int(np.count_nonzero(hidden)), 1),
    )


def _alike(one: Bytes, other: Bytes, both: Bools) -> Floats32:
    """Correlation in windows, NaN where one of both shows nothing."""
    a, b, side = one.astype(np.float32), other.astype(np.float32), (_WINDOW, _WINDOW)
    mean_a, mean_b, noise = cv2.blur(a, side), cv2.blur(b, side), np.float32(NOISE_GREY**2)
    spread_a = np.maximum(cv2.blur(a * a, side) - mean_a**2, 0.0) + noise
    spread_b = np.maximum(cv2.blur(b * b, side) - mean_b**2, 0.0) + noise
    found = (cv2.blur(a * b, side) - mean_a * mean_b) / np.sqrt(spread_a * spread_b)
    whole = cv2.erode(both.astype(np.uint8), _INSIDE) > 0
    return np.where(whole, found, np.float32(np.nan)).astype(np.float32)


def _median(of: Sequence[Floats32]) -> Floats32:
    """Of what is known; NaN where nothing is."""
    all_of = np.sort(np.stack(of), axis=0)  # NaN come last
    number = np.isfinite(all_of).sum(axis=0)
    low, high = (np.maximum(n, 0)[None] for n in ((number - 1) // 2, number // 2))
    high = np.minimum(high, np.maximum(number - 1, 0)[None])
    middle = (np.take_along_axis(all_of, low, 0) + np.take_along_axis(all_of, high, 0))[0] / 2.0
    return np.where(number > 0, middle, np.nan).astype(np.float32)
