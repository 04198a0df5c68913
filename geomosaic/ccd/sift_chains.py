"""The chains of Cheng et al. 2018: SIFT in the overlap, ratio test, RANSAC; one offset for the scene, or segments.

`whole_scene` is their old chain, `piecewise_linear` the new one. Both see each pair by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geomosaic.ccd.model import BRIDGED, MEASURED, UNRELIABLE, Flags, Floats, Overlap, PairOffsets, Settings
from geomosaic.matching.features import grey, sift_features
from geomosaic.survey.strips import StripGeometry

_PIECE_LINES = 2048
_AGREE_PX = 1.0
_LEAST_POINTS = 4
_ABNORMAL_PX = 2.0
_NOTHING_SD_PX = 10.0


@dataclass(frozen=True)
class Matched:
    """Points found in both strips: left_px (m, 2) col, line of the left array; moved_px (m, 2) dcol, dline."""

    left_px: Floats
    moved_px: Floats

    def __len__(self) -> int:
        return len(self.left_px)


@dataclass(frozen=True)
class Segments:
    """Of one pair: centre_line (s,), offset_px and sd_px (s, 2), points (s,) agreeing, kept (s,) bool."""

    centre_line: Floats
    offset_px: Floats
    sd_px: Floats
    points: np.ndarray[tuple[int], np.dtype[np.intp]]
    kept: Flags


def matched_points(
    overlap: Overlap, geometry: StripGeometry, settings: Settings, lines: slice, enhance: bool
) -> Matched:
    """SIFT points of a piece of the overlap whose nearest descriptor is clearly the nearest (Lowe 2004).

    enhance: the piece's grey range is stretched for matching, and for matching only.
    """
    valid = overlap.valid[lines]
    both = (valid * np.uint8(255)).astype(np.uint8)
    if not valid.any():
        return Matched(np.zeros((0, 2)), np.zeros((0, 2)))
    found = []
    for image in (overlap.left[lines], overlap.right[lines]):
        if enhance:
            eight = grey(image[..., None].astype(np.uint16), both)
        else:
            eight = (image.astype(np.float32) * (255.0 / (2.0**geometry.bit_depth - 1))).astype(np.uint8)
        found.append(sift_features(eight, both, 1))
    left, right = found
    if len(left) < 2 or len(right) < 2:
        return Matched(np.zeros((0, 2)), np.zeros((0, 2)))
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(
        left.descriptors.astype(np.float32), right.descriptors.astype(np.float32), k=2
    )
    good = [
        (p[0].queryIdx, p[0].trainIdx)
        for p in pairs
        if len(p) == 2 and p[0].distance < settings.ratio * p[1].distance
    ]
    index = np.array(good, dtype=np.intp).reshape(-1, 2)
    a, b = left.image_px[index[:, 0]], right.image_px[index[:, 1]]
    moved = b - a
    moved[:, 0] += geometry.read_px - geometry.overlap_px
    near = (np.abs(moved[:, 0]) <= settings.search_cols_px) & (
        np.abs(moved[:, 1]) <= settings.search_lines_px
    )
    a = a + [0.0, float(lines.start or 0)]
    return Matched(a[near], moved[near])


def consensus(moved_px: Floats, agree_px: float = _AGREE_PX) -> tuple[Floats, Flags]:
    """The shift on which most agree, and who does: RANSAC with every point tried (Fischler and Bolles 1981)."""
    if not len(moved_px):
        return np.zeros(2), np.zeros(0, dtype=bool)
    tried = moved_px[:: max(1, len(moved_px) // 500)]
    near = (np.abs(moved_px[None] - tried[:, None]) <= agree_px).all(axis=2)
    inside = near[int(near.sum(axis=1).argmax())]
    return np.asarray(moved_px[inside].mean(axis=0)), inside


def whole_scene(
    overlaps: Sequence[Overlap], geometry: StripGeometry, settings: Settings
) -> tuple[PairOffsets, ...]:
    """One offset for the scene and pair: the old chain."""
    out = []
    for overlap in overlaps:
        n = len(overlap.left)
        pieces = [
            matched_points(overlap, geometry, settings, slice(top, min(top + _PIECE_LINES, n)), False)
            for top in range(0, n, _PIECE_LINES)
        ]
        moved = np.concatenate([piece.moved_px for piece in pieces])
        shift, inside = consensus(moved)
        enough = int(inside.sum()) >= _LEAST_POINTS
        sd = moved[inside].std(axis=0) if enough else np.full(2, _NOTHING_SD_PX)
        curve = np.repeat(shift[:, None], n, axis=1)
        label = np.full(n, MEASURED if enough else UNRELIABLE)
        out.append(_offsets(overlap, geometry, curve, np.repeat(sd[:, None], n, axis=1), label))
    return tuple(out)


def segments(overlap: Overlap, geometry: StripGeometry, settings: Settings) -> Segments:
    """Offsets segment by segment; abnormal ones, far from the middle of their neighbours, are not kept."""
    n, length = len(overlap.left), settings.segment_lines
    tops = list(range(0, n, length))
    offset, sd = np.zeros((len(tops), 2)), np.full((len(tops), 2), _NOTHING_SD_PX)
    points = np.zeros(len(tops), dtype=np.intp)
    centre = np.zeros(len(tops))
    for s, top in enumerate(tops):
        lines = slice(top, min(top + length, n))
        centre[s] = 0.5 * (lines.start + lines.stop - 1)
        found = matched_points(overlap, geometry, settings, lines, settings.enhance)
        offset[s], inside = consensus(found.moved_px)
        points[s] = inside.sum()
        if points[s] >= _LEAST_POINTS:
            sd[s] = found.moved_px[inside].std(axis=0) / points[s] ** 0.5
            centre[s] = found.left_px[inside, 1].mean() - 0.5
    kept = points >= _LEAST_POINTS
    near = np.array([_middle(offset, kept, s) for s in range(len(tops))])
    kept &= np.abs(offset - near).max(axis=1) <= _ABNORMAL_PX
    return Segments(centre, offset, sd, points, kept)


def piecewise_linear(
    overlaps: Sequence[Overlap], geometry: StripGeometry, settings: Settings
) -> tuple[PairOffsets, ...]:
    """Offsets linear between the centres of the segments kept: the new chain."""
    out = []
    for overlap in overlaps:
        n = len(overlap.left)
        found = segments(overlap, geometry, settings)
        if not found.kept.any():
            none = np.full(n, UNRELIABLE)
            out.append(_offsets(overlap, geometry, np.zeros((2, n)), np.full((2, n), _NOTHING_SD_PX), none))
            continue
        t = np.arange(n, dtype=np.float64)
        at = found.centre_line[found.kept]
        curve, sd = (
            np.stack([np.interp(t, at, values[found.kept, axis]) for axis in (0, 1)])
            for values in (found.offset_px, found.sd_px)
        )
        own = found.kept[np.minimum((t // settings.segment_lines).astype(np.intp), len(found.kept) - 1)]
        out.append(_offsets(overlap, geometry, curve, sd, np.where(own, MEASURED, BRIDGED)))
    return tuple(out)


def _middle(offset_px: Floats, kept: Flags, s: int) -> Floats:
    """Median offset of the segments about one, itself included."""
    near = slice(max(0, s - 3), s + 4)
    some = offset_px[near][kept[near]]
    return np.median(some, axis=0) if len(some) else offset_px[s]


def _offsets(
    overlap: Overlap,
    geometry: StripGeometry,
    curve: Floats,
    sd: Floats,
    label: np.ndarray[tuple[int], np.dtype[np.intp]],
) -> PairOffsets:
    whole = overlap.side * geometry.row_separation_lines
    seen = overlap.valid.any(axis=1)
    return PairOffsets(
        overlap.pair,
        curve[0],
        curve[1] + round(whole) - whole,
        sd[0],
        sd[1],
        np.where(seen, label, UNRELIABLE).astype(np.uint8),
    )
