"""One pair of frames: guided by the predicted geometry first, free where that fails."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import CHOSEN, Because
from geomosaic.matching.features import Features, coarsest
from geomosaic.matching.search import CHECKS, root_sift, search

Floats = NDArray[np.float64]
_FREE_LEAST: Annotated[
    float,
    Because(
        "of a guided pair's least number of tie points",
        "what a free search must bring, since nothing but the image supports it: with less, frames of "
        "unlike ground are tied by chance; with more, frames whose positions are wrong stay loose",
        CHOSEN,
    ),
] = 1.5
_FEW: Annotated[
    int,
    Because(
        "keypoints of a frame",
        "the coarsest, compared first: of an overlap of a third, some hundred are seen again; fewer say "
        "less about small overlaps, more take the time that is saved",
        "chosen; docs/results.md, matching: with it 74 pairs take 4.8 s instead of 19.6 and have more tie "
        "points",
    ),
] = 1200
_TOLERANCES: Annotated[
    float,
    Because(
        "tolerances of the check",
        "least radius about a predicted place: holds enough keypoints for Lowe's ratio to mean much; a "
        "smaller one lets wrong ones pass, a larger one takes time",
        CHOSEN,
    ),
] = 12.0
_SPREAD: Annotated[
    float,
    Because(
        "90 % quantiles of the coarsest keypoints' misses",
        "radius about a predicted place where relief and lens bend the plane through them: less cuts off "
        "hills and corners, more compares with ground that isn't there",
        CHOSEN,
    ),
] = 3.0


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

    A free search, which nothing but the image supports, must bring half as many again.
    """
    left, right = root_sift(job.left.descriptors), root_sift(job.right.descriptors)
    guided = [] if np.isinf(job.radius_m) else [(job.radius_m, job.least)]
    for radius_m, least in (*guided, (np.inf, int(_FREE_LEAST * job.least))):
        i, j = _candidates(job, left, right, radius_m)
        good = CHECKS[job.check](job.left.image_px[i], job.right.image_px[j], job.tolerance_px)
        i, j = _once_per_place(job, i[good], j[good])
        if len(i) >= least:
            return PairMatch(i.astype(np.int32), j.astype(np.int32), bool(np.isinf(radius_m)))
    nothing = np.zeros(0, np.int32)
    return PairMatch(nothing, nothing, False)


def _candidates(
    job: PairJob, left: NDArray[np.float32], right: NDArray[np.float32], radius_m: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Candidate tie points: the coarsest keypoints say where in the right image the left one lies, and the
    rest is compared about there; all within the radius on the ground where the coarsest don't say it."""
    few_i, few_j = coarsest(job.left, _FEW), coarsest(job.right, _FEW)
    here_m, there_m = job.left_ground_m[:, :2], job.right_ground_m[:, :2]
    i, j = search(left[few_i], right[few_j], here_m[few_i], there_m[few_j], radius_m, job.ratio)
    i, j = few_i[i], few_j[j]
    good = CHECKS[job.check](job.left.image_px[i], job.right.image_px[j], job.tolerance_px)
    if good.sum() >= job.least:
        seen, there = job.left.image_px[i[good]], job.right.image_px[j[good]]
        plane, _ = cv2.findHomography(seen, there, 0)
        if plane is not None:
            at = np.asarray(cv2.perspectiveTransform(job.left.image_px[:, None], plane)[:, 0], np.float64)
            off_px = np.linalg.norm(at[i[good]] - there, axis=1)
            radius_px = max(_TOLERANCES * job.tolerance_px, _SPREAD * float(np.quantile(off_px, 0.9)))
            return search(left, right, at, job.right.image_px, radius_px, job.ratio)
    return search(left, right, here_m, there_m, radius_m, job.ratio)


def _once_per_place(job: PairJob, i: NDArray[np.intp], j: NDArray[np.intp]) -> tuple[NDArray[np.intp], ...]:
    """SIFT gives one place several orientations; count it once."""
    places = np.concatenate([job.left.image_px[i], job.right.image_px[j]], axis=1).round(1)
    _, first = np.unique(places, axis=0, return_index=True)
    first.sort()
    return i[first], j[first]
