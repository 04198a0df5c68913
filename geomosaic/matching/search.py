"""From two frames' keypoints to tie points: search, then geometric check."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bytes = NDArray[np.uint8]
_ROWS = 512


def root_sift(descriptors: Bytes) -> NDArray[np.float32]:
    """Hellinger form of SIFT descriptors (Arandjelović and Zisserman 2012), unit length."""
    d = descriptors.astype(np.float32)
    return np.asarray(np.sqrt(d / np.maximum(d.sum(axis=1, keepdims=True), 1.0)))


def mutual_nearest(left: NDArray[np.float32], right: NDArray[np.float32], ratio: float) -> tuple[Ints, Ints]:
    """Index pairs that are each other's nearest descriptor and pass Lowe's ratio test from the left."""
    nothing = np.zeros(0, np.intp)
    if len(left) < 2 or len(right) < 2:
        return nothing, nothing
    best = np.empty(len(left), np.intp)
    distinct = np.empty(len(left), np.bool_)
    column_best = np.full(len(right), -1.0, np.float32)
    back = np.zeros(len(right), np.intp)
    for start in range(0, len(left), _ROWS):
        likeness = left[start : start + _ROWS] @ right.T
        rows = np.arange(len(likeness))
        nearest = likeness.argmax(axis=1)
        first = likeness[rows, nearest]
        top = likeness.argmax(axis=0)
        highest = likeness[top, np.arange(len(right))]
        better = highest > column_best
        column_best[better], back[better] = highest[better], top[better] + start
        likeness[rows, nearest] = -1.0
        best[start : start + _ROWS] = nearest
        distinct[start : start + _ROWS] = (1.0 - first) < ratio**2 * (1.0 - likeness.max(axis=1))
    kept = np.flatnonzero((back[best] == np.arange(len(left))) & distinct)
    return kept, best[kept]


def search(
    left_descriptors: NDArray[np.float32],
    right_descriptors: NDArray[np.float32],
    left_ground_m: Floats,
    right_ground_m: Floats,
    radius_m: float,
    ratio: float = 0.8,
) -> tuple[Ints, Ints]:
    """Candidate tie points whose predicted ground positions differ by at most radius_m.

    Guided: only keypoints in the predicted overlap, grown by the radius, are compared. With an
    infinite radius the search is free: all keypoints of both frames.
    """
    if np.isinf(radius_m):
        return mutual_nearest(left_descriptors, right_descriptors, ratio)
    inside_left = _within(left_ground_m, right_ground_m, radius_m)
    inside_right = _within(right_ground_m, left_ground_m, radius_m)
    i, j = mutual_nearest(left_descriptors[inside_left], right_descriptors[inside_right], ratio)
    i, j = inside_left[i], inside_right[j]
    near = np.linalg.norm(left_ground_m[i, :2] - right_ground_m[j, :2], axis=1) <= radius_m
    return i[near], j[near]


def _within(points_m: Floats, others_m: Floats, margin_m: float) -> Ints:
    if not len(others_m) or not np.isfinite(others_m[:, :2]).all(axis=1).any():
        return np.zeros(0, np.intp)
    low = np.nanmin(others_m[:, :2], axis=0) - margin_m
    high = np.nanmax(others_m[:, :2], axis=0) + margin_m
    return np.flatnonzero(((points_m[:, :2] >= low) & (points_m[:, :2] <= high)).all(axis=1))


def by_homography(left_px: Floats, right_px: Floats, tolerance_px: float) -> NDArray[np.bool_]:
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


def by_epipolar_line(left_px: Floats, right_px: Floats, tolerance_px: float) -> NDArray[np.bool_]:
    """Inliers of the epipolar geometry of two views of relief, by MAGSAC++."""
    if len(left_px) < 8:
        return np.zeros(len(left_px), np.bool_)
    try:
        _, mask = cv2.findFundamentalMat(left_px, right_px, cv2.USAC_MAGSAC, tolerance_px, 0.9999, 5000)
    except cv2.error:
        mask = None
    return np.zeros(len(left_px), np.bool_) if mask is None else mask.ravel() > 0


def by_better(left_px: Floats, right_px: Floats, tolerance_px: float) -> NDArray[np.bool_]:
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


CHECKS: dict[str, Callable[[Floats, Floats, float], NDArray[np.bool_]]] = {
    "auto": by_better,
    "homography": by_homography,
    "epipolar": by_epipolar_line,
}
