"""Which frames may see the same ground where no position says so: by their coarsest keypoints."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.constants import tuned
from geomosaic.matching.features import Features, coarsest
from geomosaic.matching.planes import LEAST_POINTS
from geomosaic.matching.search import by_homography, mutual_nearest, root_sift

Pair = tuple[int, int]
MOST_COMPARED = tuned(20_000, "pairs", "all of 200 frames: fewer try neighbours in time only; more are slow")
_COARSEST = tuned(400, "keypoints", "of a frame: fewer miss small overlaps; time grows with the square")
_TOLERANCE = tuned(0.01, "share", "of the extent, off the homography: less needs a plane; more admits any")
_RATIO = tuned(0.85, "distance ratio", "looser than 0.8, as the homography filters: less loses true ones")
_NEIGHBOURS = tuned(12, "pairs", "of a frame: fewer leave lines untied; more take time and show the same")


@dataclass(frozen=True)
class FrameComparison:
    """One frame against some others."""

    frame: Features
    others: tuple[Features, ...]


def coarse(features: Features) -> Features:
    """The keypoints that an image of a few hundred pixels would have."""
    largest = coarsest(features, _COARSEST)
    return Features(features.image_px[largest], features.size_px[largest], features.descriptors[largest])


def to_compare(n: int, frames: Collection[int], most: int = MOST_COMPARED) -> list[tuple[int, list[int]]]:
    """Each of some frames with all others; where those were more than `most` pairs, with as many of them
    next to it in order of capture as keep to it. No pair comes twice."""
    wanted = sorted(frames)
    m = len(wanted)
    once = m if m == n else 2 * m  # of two wanted frames, a pair counts once
    reach = n if m * (n - m) + m * (m - 1) // 2 <= most else max(2, most // once)
    done = set(wanted)
    return [
        (i, [j for j in range(max(0, i - reach), min(n, i + reach + 1)) if j > i or j not in done])
        for i in wanted
    ]


def alike(job: FrameComparison) -> list[int]:
    """How many keypoints of the frame lie by one homography in each of the others; 0 where too few."""
    left, px = root_sift(job.frame.descriptors), job.frame.image_px
    tolerance_px = _TOLERANCE * float(np.ptp(px, axis=0).max()) if len(px) else 0.0
    out = []
    for other in job.others:
        i, j = mutual_nearest(left, root_sift(other.descriptors), _RATIO)
        good = 0
        if len(i) >= LEAST_POINTS:
            good = int(by_homography(px[i], other.image_px[j], tolerance_px).sum())
        out.append(good if good >= LEAST_POINTS else 0)
    return out


def likely_pairs(compared: Sequence[tuple[int, list[int]]], found: Sequence[list[int]]) -> list[Pair]:
    """Pairs (left < right) that share keypoints, by falling number; of each frame the best _NEIGHBOURS, and
    those that another frame asks for."""
    shared = {
        (min(i, j), max(i, j)): count
        for (i, others), counts in zip(compared, found, strict=True)
        for j, count in zip(others, counts, strict=True)
        if count
    }
    ranked = sorted(shared, key=lambda pair: (-shared[pair], pair))
    asked: dict[int, int] = {}
    out = []
    for pair in ranked:
        if min(asked.get(i, 0) for i in pair) < _NEIGHBOURS:
            out.append(pair)
        for i in pair:
            asked[i] = asked.get(i, 0) + 1
    return out
