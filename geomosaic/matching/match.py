"""One pair of frames: guided by the predicted geometry first, free where that fails."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomosaic.matching.features import Features
from geomosaic.matching.search import CHECKS, root_sift, search

Floats = NDArray[np.float64]
_FREE_LEAST = 1.5


@dataclass(frozen=True)
class PairJob:
    """What matching a pair needs. Ground: (n, 2) east and north where each keypoint is believed to be; with
    an infinite radius nothing is believed."""

    left: Features
    right: Features
    left_ground_m: Floats
    right_ground_m: Floats
    radius_m: float
    tolerance_px: float
    ratio: float
    check: str
    least: int


@dataclass(frozen=True)
class PairMatch:
    """Keypoint numbers of the tie points; empty if the pair doesn't hold together. `free`: found
    against the prediction, over the whole of both frames."""

    left: NDArray[np.int32]
    right: NDArray[np.int32]
    free: bool


def match_pair(job: PairJob) -> PairMatch:
    """Tie points of a pair: search, one-to-one, geometric check, at least `least` of them.

    A free search, which nothing but the picture supports, must bring half as many again.
    """
    left, right = root_sift(job.left.descriptors), root_sift(job.right.descriptors)
    guided = [] if np.isinf(job.radius_m) else [(job.radius_m, job.least)]
    for radius_m, least in (*guided, (np.inf, int(_FREE_LEAST * job.least))):
        i, j = search(left, right, job.left_ground_m, job.right_ground_m, radius_m, job.ratio)
        good = CHECKS[job.check](job.left.image_px[i], job.right.image_px[j], job.tolerance_px)
        i, j = _once_per_place(job, i[good], j[good])
        if len(i) >= least:
            return PairMatch(i.astype(np.int32), j.astype(np.int32), bool(np.isinf(radius_m)))
    nothing = np.zeros(0, np.int32)
    return PairMatch(nothing, nothing, False)


def _once_per_place(job: PairJob, i: NDArray[np.intp], j: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """SIFT gives one place several orientations; count it once."""
    places = np.concatenate([job.left.image_px[i], job.right.image_px[j]], axis=1).round(1)
    _, first = np.unique(places, axis=0, return_index=True)
    first.sort()
    return i[first], j[first]
