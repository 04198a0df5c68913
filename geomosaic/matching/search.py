"""From two frames' keypoints to tie points: search, then geometric check."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats, Floats32, Ints
from geomosaic.constants import TOGETHER, tuned

_IN_CELL = tuned(150, "keypoints", "in a search cell: fewer starve the ratio test; more compare in vain")


def root_sift(descriptors: Bytes) -> Floats32:
    """Hellinger form of SIFT descriptors (Arandjelović and Zisserman 2012), unit length."""
    d = descriptors.astype(np.float32)
    d /= np.maximum(d.sum(axis=1, keepdims=True), np.float32(1.0))
    return np.sqrt(d, out=d)


def mutual_nearest(
    left: Floats32,
    right: Floats32,
    ratio: float,
    among: Iterable[tuple[Ints, Ints]] | None = None,
) -> tuple[Ints, Ints]:
    """Index pairs that are each other's nearest descriptor and pass Lowe's ratio test from the left.

    Args: among: which of the left are compared with which of the right, no left one twice; all with all
        if not given.
    """
    if len(left) < 2 or len(right) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    best = np.zeros(len(left), np.intp)
    first = np.full(len(left), np.nan, np.float32)
    distinct = np.zeros(len(left), np.bool_)
    highest = np.full(len(right), -1.0, np.float32)
    for here, there in among or [(np.arange(len(left)), np.arange(len(right)))]:
        if len(there) < 2:
            continue
        candidates = right.take(there, axis=0).T
        for start in range(0, len(here), TOGETHER):
            part = here[start : start + TOGETHER]
            likeness = left.take(part, axis=0) @ candidates
            rows = np.arange(len(part))
            nearest = likeness.argmax(axis=1)
            best[part], first[part] = there[nearest], likeness[rows, nearest]
            highest[there] = np.maximum(highest[there], likeness.max(axis=0))
            likeness[rows, nearest] = -1.0
            distinct[part] = (1.0 - first[part]) < ratio**2 * (1.0 - likeness.max(axis=1))
    kept = np.flatnonzero((first == highest[best]) & distinct)
    kept = kept[np.sort(np.unique(best[kept], return_index=True)[1])]
    return kept, best[kept]


@dataclass(frozen=True)
class PlacedKeypoints:
    """A frame's keypoints: root (n, 128) as `root_sift` gives them, and at (n, 2), their places in any system
    that two frames share; NaN where a keypoint has none."""

    root: Floats32
    at: Floats

    def of(self, some: Ints) -> PlacedKeypoints:
        """Those of some numbers."""
        return PlacedKeypoints(self.root[some], self.at[some])


def search(
    left: PlacedKeypoints, right: PlacedKeypoints, radius: float, ratio: float = 0.8
) -> tuple[Ints, Ints]:
    """Candidate tie points whose places are at most a radius apart.

    Guided: only keypoints of a cell and at most a radius from it are compared. With an infinite radius the
    search is free: all keypoints of both frames.

    Args: radius: in the unit of the places.
    """
    if np.isinf(radius):
        return mutual_nearest(left.root, right.root, ratio)
    i, j = mutual_nearest(left.root, right.root, ratio, _near(left.at, right.at, radius))
    near = np.linalg.norm(left.at[i] - right.at[j], axis=1) <= radius
    return i[near], j[near]


def _near(left: Floats, right: Floats, radius: float) -> Iterator[tuple[Ints, Ints]]:
    """Left keypoints cell by cell, and the right ones at most a radius from the cell."""
    there = np.flatnonzero(np.isfinite(right).all(axis=1))
    here = np.flatnonzero(np.isfinite(left).all(axis=1))
    if not len(there) or not len(here):
        return
    col, row = np.ascontiguousarray(right[there].T)
    low = np.array([col.min(), row.min()]) - radius
    high = np.array([col.max(), row.max()]) + radius
    here = here[((left[here] >= low) & (left[here] <= high)).all(axis=1)]
    side = np.maximum(2.0 * radius, (high - low) / max(1.0, np.sqrt(len(there) // _IN_CELL)))
    cell = np.floor((left[here] - low) / side).astype(np.intp)
    order = np.lexsort(cell.T)
    starts = np.flatnonzero(np.diff(cell[order], axis=0, prepend=-1).any(axis=1))
    for members in np.split(order, starts[1:]) if len(order) else ():
        at = left[here[members]]
        (west, north), (east, south) = at.min(axis=0) - radius, at.max(axis=0) + radius
        yield here[members], there[(col >= west) & (col <= east) & (row >= north) & (row <= south)]


def by_homography(left_px: Floats, right_px: Floats, tolerance_px: float) -> Bools:
    """Inliers of one plane seen from two places, by MAGSAC++ (Barath et al. 2020); none where OpenCV
    finds no model (it raises on some degenerate sets)."""
    if len(left_px) < 4:
        return np.zeros(len(left_px), np.bool_)
    try:
        _, mask = cv2.findHomography(
            left_px, right_px, cv2.USAC_MAGSAC, tolerance_px, maxIters=5000, confidence=0.9999
        )
    except cv2.error:
        mask = None
    return np.zeros(len(left_px), np.bool_) if mask is None else mask.ravel() > 0


def by_epipolar_line(left_px: Floats, right_px: Floats, tolerance_px: float) -> Bools:
    """Inliers of the epipolar geometry of two views of relief, by MAGSAC++."""
    if len(left_px) < 8:
        return np.zeros(len(left_px), np.bool_)
    try:
        _, mask = cv2.findFundamentalMat(left_px, right_px, cv2.USAC_MAGSAC, tolerance_px, 0.9999, 5000)
    except cv2.error:
        mask = None
    return np.zeros(len(left_px), np.bool_) if mask is None else mask.ravel() > 0


def by_better(left_px: Floats, right_px: Floats, tolerance_px: float) -> Bools:
    """The plane, unless the epipolar geometry holds clearly more: then there is relief.

    The plane constrains both coordinates, so that fewer wrong matches pass; over relief it would
    throw away every point off the main plane. Epipolar inliers must also lie near the plane's
    prediction, within the parallax that a twentieth of the frame's side allows.
    """
    plane = by_homography(left_px, right_px, tolerance_px)
    line = by_epipolar_line(left_px, right_px, tolerance_px)
    if plane.sum() < 8 or line.sum() <= 1.2 * plane.sum():
        return plane
    h, _ = cv2.findHomography(left_px[plane], right_px[plane], 0)
    if h is None:
        return plane
    predicted = cv2.perspectiveTransform(left_px[:, None], h)[:, 0]
    extent = float(np.ptp(left_px, axis=0).max())
    near = np.linalg.norm(predicted - right_px, axis=1) < max(extent / 20.0, 10.0 * tolerance_px)
    return np.asarray((line & near) | plane)


CHECKS: dict[str, Callable[[Floats, Floats, float], Bools]] = {
    "auto": by_better,
    "homography": by_homography,
    "epipolar": by_epipolar_line,
}
