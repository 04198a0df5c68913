"""The chains of Cheng et al. 2018: SIFT, ratio test, RANSAC; one offset for the scene, or segments.

`whole_scene` is their old chain, `piecewise_linear` the new one. Both see each pair by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.ccd.columns import column_gains
from geomosaic.ccd.model import (
    BRIDGED,
    MEASURED,
    UNKNOWN_SD_PX,
    UNRELIABLE,
    CcdSettings,
    Overlap,
    PairOffsets,
    Progress,
)
from geomosaic.ccd.overlaps import Strips
from geomosaic.constants import NORMAL_PER_MAD, tuned
from geomosaic.matching.features import grey, sift_features
from geomosaic.survey.strips import StripGeometry

NEAR_PX = tuned(0.5, "px", "off the scene's offset, for measured lines: more admits misplaced ones")
LEAST_POINTS = tuned(6, "points", "that agree: fewer do by chance among 100; more lose low contrast")
ABNORMAL_PX = tuned(2.0, "px", "off its neighbours' line: less rejects jitter; more keeps clouds")


@dataclass(frozen=True)
class Matched:
    """Points found in both strips.

    left_px: (m, 2) col of the left strip's read columns, line of the left strip; corner origin.
    moved_px: (m, 2) dcol, dline against the nominal geometry.
    """

    left_px: Floats
    moved_px: Floats

    def __len__(self) -> int:
        return len(self.left_px)


@dataclass(frozen=True)
class Segments:
    """Of one pair: the left strip's lines first (s,) to before stop (s,), and what their points agree on.

    centre_line, points: (s,) middle line and number of the agreeing points. offset_px, sd_px: (s, 2) col and
    line. kept: (s,) False where too few agree or the offset is abnormal.
    """

    pair: int
    first: Ints
    stop: Ints
    centre_line: Floats
    offset_px: Floats
    sd_px: Floats
    points: Ints
    kept: Bools


def pieces(strips: Strips, length: int) -> Iterator[tuple[int, int, int, int]]:
    """Every pair's lines piece by piece: pair, first line, stop, and the number of pieces there are.

    The pieces of all pairs at one time come one after the other, so that both edges of a strip are read at
    once. They reach over what both strips have by the nominal geometry, and are about `length` lines long.
    The remainder at the end makes the last one longer or shorter by up to half.
    """
    g = strips.geometry
    lag = round(g.row_separation_lines)
    ends = {}
    for pair in strips.pairs:
        early, late = (pair, pair + 1)[:: g.side(pair)]
        ends[pair] = max(0, min(g.lines[early], g.lines[late] - lag))
    counts = {pair: max(int(end > 0), round(end / length)) for pair, end in ends.items()}
    total = sum(counts.values())
    for i in range(max(counts.values(), default=0)):
        for pair, end in ends.items():
            if i < counts[pair]:
                lead = i * length, end if i == counts[pair] - 1 else (i + 1) * length
                first = 0 if g.side(pair) > 0 else lag
                yield pair, lead[0] + first, min(lead[1] + first, strips.lines(pair)), total


def matched_points(
    overlap: Overlap, geometry: StripGeometry, settings: CcdSettings, enhance: bool
) -> Matched:
    """SIFT points of a piece of an overlap whose nearest descriptor is clearly the nearest (Lowe 2004).

    The columns' unequal response is taken out first, as ground segments do before they stitch. enhance: each
    side's grey range is stretched for matching, and for matching only.
    """
    both = (overlap.valid * np.uint8(255)).astype(np.uint8)
    none = Matched(np.zeros((0, 2)), np.zeros((0, 2)))
    if not both.any():
        return none
    found = []
    for counts in (overlap.left, overlap.right):
        image = counts.astype(np.float32)
        image /= column_gains(image, overlap.valid)
        if enhance:
            eight = grey(image[..., None], both)
        else:
            full = 2.0**geometry.bit_depth - 1
            eight = np.clip(np.rint(image * (255.0 / full)), 0, 255).astype(np.uint8)
        found.append(sift_features(eight, both, (1.0, 1.0)))
    left, right = found
    if len(left) < 2 or len(right) < 2:
        return none
    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(
        left.descriptors.astype(np.float32), right.descriptors.astype(np.float32), k=2
    )
    good = [
        (best.queryIdx, best.trainIdx)
        for best, second in nearest
        if best.distance < settings.ratio * second.distance
    ]
    index = np.array(good, dtype=np.intp).reshape(-1, 2)
    a, b = left.image_px[index[:, 0]], right.image_px[index[:, 1]]
    apart = overlap.side * geometry.row_separation_lines
    moved = b - a + [geometry.read_px - geometry.overlap_px, round(apart) - apart]
    near = (np.abs(moved) <= [settings.search_cols_px, settings.search_lines_px]).all(axis=1)
    return Matched(a[near] + [0.0, overlap.first_line], moved[near])


def consensus(moved_px: Floats) -> tuple[Floats, Bools]:
    """The shift on which most agree, and who does: each point's is tried.

    Args: moved_px (m, 2). Returns: (2,) their mean, (m,).
    """
    if not len(moved_px):
        return np.zeros(2), np.zeros(0, dtype=bool)
    agree_px = 2.0 * NEAR_PX
    agreeing = cKDTree(moved_px).query_ball_point(moved_px, agree_px, p=np.inf, return_length=True)
    inside = np.asarray((np.abs(moved_px - moved_px[np.argmax(agreeing)]) <= agree_px).all(axis=1))
    for _ in range(3):
        closer = (np.abs(moved_px - moved_px[inside].mean(axis=0)) <= agree_px).all(axis=1)
        if closer.sum() < inside.sum():
            break
        inside = closer
    return np.asarray(moved_px[inside].mean(axis=0)), inside


def whole_scene(strips: Strips, settings: CcdSettings, progress: Progress) -> tuple[PairOffsets, ...]:
    """One offset for the scene and pair: the old chain, without enhancement.

    The standard deviation is the points' robust scatter about the one offset, with what drift and jitter make
    of it. A line is labelled measured where the middle of its piece's points is within 0.5 px of the offset.
    """
    found: dict[int, list[tuple[int, int, Matched]]] = {pair: [] for pair in strips.pairs}
    for done, (pair, first, stop, total) in enumerate(pieces(strips, settings.segment_lines)):
        overlap = strips.overlap(pair, first, stop)
        found[pair].append((first, stop, matched_points(overlap, strips.geometry, settings, False)))
        progress(done + 1, total)
    return tuple(_one_offset(strips.lines(pair), pair, parts) for pair, parts in found.items())


def _one_offset(lines: int, pair: int, parts: list[tuple[int, int, Matched]]) -> PairOffsets:
    moved = np.concatenate([np.zeros((0, 2)), *(part.moved_px for _, _, part in parts)])
    shift, inside = consensus(moved)
    label = np.full(lines, UNRELIABLE, dtype=np.uint8)
    sd = np.full(2, UNKNOWN_SD_PX)
    if inside.sum() >= LEAST_POINTS:
        sd = np.maximum(NORMAL_PER_MAD * np.median(np.abs(moved - shift), axis=0), moved[inside].std(axis=0))
        for first, stop, part in parts:
            enough = len(part) >= LEAST_POINTS
            near = enough and np.hypot(*(np.median(part.moved_px, axis=0) - shift)) <= NEAR_PX
            label[first:stop] = MEASURED if near else BRIDGED
    dcol, dline, sd_col, sd_line = (np.full(lines, value) for value in (*shift, *sd))
    return PairOffsets(pair, dcol, dline, sd_col, sd_line, label)


def segments(strips: Strips, settings: CcdSettings, progress: Progress) -> tuple[Segments, ...]:
    """Offsets segment by segment, for each of `strips.pairs`; with `settings.enhance` or without."""
    rows: dict[int, list[tuple[float, ...]]] = {pair: [] for pair in strips.pairs}
    for done, (pair, first, stop, total) in enumerate(pieces(strips, settings.segment_lines)):
        overlap = strips.overlap(pair, first, stop)
        found = matched_points(overlap, strips.geometry, settings, settings.enhance)
        offset, inside = consensus(found.moved_px)
        points, sd, centre = int(inside.sum()), np.full(2, UNKNOWN_SD_PX), 0.5 * (first + stop - 1)
        if points >= LEAST_POINTS:
            sd = found.moved_px[inside].std(axis=0, ddof=1) / points**0.5
            centre = float(found.left_px[inside, 1].mean()) - 0.5
        rows[pair].append((first, stop, centre, *offset, *sd, points))
        progress(done + 1, total)
    return tuple(_segments(pair, np.array(part).reshape(-1, 8)) for pair, part in rows.items())


def _segments(pair: int, rows: Floats) -> Segments:
    first, stop, points = (rows[:, i].astype(np.intp) for i in (0, 1, 7))
    kept = steady(rows[:, 2], rows[:, 3:5], points >= LEAST_POINTS)
    return Segments(pair, first, stop, rows[:, 2], rows[:, 3:5], rows[:, 5:7], points, kept)


def steady(at: Floats, values: Floats, given: Bools) -> Bools:
    """Which of the values given (n, 2) are not abnormal; the platform moves slowly (Cheng et al. 2018).

    Abnormal is what leaves the line between its neighbours by more than 2 px; at an end, both the neighbour
    and the line through the next two. The worst goes first, the others are then seen anew.
    """
    kept = given.copy()
    while kept.sum() >= 4:
        index = np.flatnonzero(kept)
        t, v = at[index, None], values[index]
        away = np.zeros_like(v)
        away[1:-1] = v[1:-1] - v[:-2] - (v[2:] - v[:-2]) * (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
        for end, one, two in ((0, 1, 2), (-1, -2, -3)):
            line = v[end] - v[one] - (v[two] - v[one]) * (t[end] - t[one]) / (t[two] - t[one])
            away[end] = np.where(np.abs(line) < np.abs(v[end] - v[one]), line, v[end] - v[one])
        worst = np.abs(away).max(axis=1)
        if worst.max() <= ABNORMAL_PX:
            break
        kept[index[int(worst.argmax())]] = False
    return kept


def piecewise_linear(strips: Strips, settings: CcdSettings, progress: Progress) -> tuple[PairOffsets, ...]:
    """Offsets linear between the centres of the segments kept: the new chain.

    The standard deviation has two parts: the points' own, and that of the way in between, which the segments'
    departures from their neighbours show. It grows with the distance to the next segment kept.
    """
    return tuple(_polyline(strips.lines(found.pair), found) for found in segments(strips, settings, progress))


def _polyline(lines: int, found: Segments) -> PairOffsets:
    label = np.full(lines, UNRELIABLE, dtype=np.uint8)
    if not found.kept.any():
        zero, far = np.zeros(lines), np.full(lines, UNKNOWN_SD_PX)
        return PairOffsets(found.pair, zero, zero.copy(), far, far.copy(), label)
    t = np.arange(lines, dtype=np.float64)
    at, offset, own_sd = (a[found.kept] for a in (found.centre_line, found.offset_px, found.sd_px))
    curve = [np.interp(t, at, offset[:, axis]) for axis in (0, 1)]
    sd = [
        bridging_sd(t, at, offset[:, axis], np.interp(t, at, own_sd[:, axis]), found.stop[0] - found.first[0])
        for axis in (0, 1)
    ]
    for first, stop, kept in zip(found.first, found.stop, found.kept, strict=True):
        label[first:stop] = MEASURED if kept else BRIDGED
    return PairOffsets(found.pair, curve[0], curve[1], sd[0], sd[1], label)


def bridging_sd(t: Floats, at: Floats, values: Floats, own_sd: Floats, reach: float) -> Floats:
    """Standard deviation at t of a polyline through values (k,) at `at`, whose own are own_sd (at t).

    Two parts follow from how far evenly spaced values are from their neighbours. Departures from a cubic
    through four of them give the noise. Those from the line between two, beyond that noise, give the bend of
    the curve; between values about a fifth of it is left. Beyond `reach` lines of any value the curve may
    have gone at its usual rate, at most as far as its whole spread.
    """
    step = np.diff(at)
    even = np.flatnonzero([(step[i : i + 4] < 1.5 * np.median(step)).all() for i in range(len(at) - 4)]) + 2
    if not even.size:
        return np.asarray(np.hypot(own_sd, 1.0 + np.abs(t - at.mean()) / max(reach, 1.0)))
    before2, before, own, after, after2 = (values[even + i] for i in (-2, -1, 0, 1, 2))
    four = own - (4.0 * (before + after) - before2 - after2) / 6.0
    noise = float((four**2).mean()) / (1.0 + 34.0 / 36.0)
    two = own - 0.5 * (before + after)
    bend = max(float((two**2).mean()) - 1.5 * noise, 0.0) * 0.2**2
    rate = float(np.sqrt((np.diff(values) ** 2).mean() / (step**2).mean()))
    right = np.clip(np.searchsorted(at, t), 1, len(at) - 1)
    away = np.maximum(np.minimum(np.abs(t - at[right - 1]), np.abs(at[right] - t)) - reach, 0.0)
    return np.asarray(np.sqrt(own_sd**2 + noise + bend + np.minimum(rate * away, np.ptp(values)) ** 2))
