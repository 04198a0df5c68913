"""All pairs at once: one motion for all, an own slow part for each, clouds set aside (method `joint`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from geomosaic.ccd.least_squares_matching import Cells, Pictures, measure, pictures
from geomosaic.ccd.model import (
    BRIDGED,
    MEASURED,
    UNRELIABLE,
    Flags,
    Floats,
    Overlap,
    PairOffsets,
    Progress,
    Settings,
)
from geomosaic.ccd.motion import FIRST_HABITS, Habits, Smoothed, learned, smooth
from geomosaic.ccd.overlaps import Strips
from geomosaic.ccd.paths import block_centres, coarse_offsets
from geomosaic.ccd.rows import RowPair, left_lines, of_left, row_pair, shared_length
from geomosaic.ccd.volumes import BLOCK_LINES, volume
from geomosaic.survey.strips import StripGeometry

_COARSE_SD_PX = 1.2
# The way through the volumes, everywhere: little, but nothing runs off where nothing else is known.
_ANCHOR_SD_PX = 40.0
_FAR_PX = 3.5
# What the cubic kernel leaves of the sub-pixel phase.
_RESAMPLING_SD_PX = 0.004
_MEASURED_SD_PX = 0.25
_RELIABLE_SD_PX = 0.6


def joint(strips: Strips, settings: Settings, progress: Progress) -> tuple[PairOffsets, ...]:
    """Offsets of every line of every pair, with standard deviations."""
    progress(0, 1)
    found = _window([strips.overlap(pair) for pair in strips.pairs], strips.geometry, settings)
    progress(1, 1)
    return found


def _window(
    overlaps: Sequence[Overlap], geometry: StripGeometry, settings: Settings
) -> tuple[PairOffsets, ...]:
    """Offsets of every line of every pair, with standard deviations.

    The overlaps are seen from their leading strips (`rows`); correlation volumes give the way to a pixel
    (`paths`), least squares matching of small cells refines it (`least_squares_matching`), and a smoother
    (`motion`) draws the curves and bridges what clouds hide.
    """
    pairs = [row_pair(overlap, geometry) for overlap in overlaps]
    step = settings.knot_lines
    lines = shared_length(pairs)
    knots = lines // step
    if knots < 16:
        return tuple(_nothing(overlap) for overlap in overlaps)
    centres = np.arange(knots) * float(step) + (step - 1) / 2
    coarse, weights = _start(pairs, lines, centres, settings)
    level = np.median(coarse, axis=1)
    now = smooth(coarse, weights, level, FIRST_HABITS)
    habits = FIRST_HABITS
    cells: list[Cells] = []
    for scale, rounds in ((2, 2), (1, 2)):
        ready = [pictures(pair, scale) for pair in pairs]
        for turn in range(rounds):
            last = scale == 1 and turn == rounds - 1
            now, cells, habits = _refined(ready, now, coarse, centres, lines, step, habits, last)
    return tuple(
        _of_pair(pair, overlap, geometry, now, k, cells[k], centres, lines)
        for k, (pair, overlap) in enumerate(zip(pairs, overlaps, strict=True))
    )


def _start(pairs: list[RowPair], lines: int, centres: Floats, settings: Settings) -> tuple[Floats, Floats]:
    """Offsets and their information at the knots, from correlation volumes."""
    blocks = max(lines // BLOCK_LINES, 1)
    volumes = np.zeros(
        (len(pairs), blocks, settings.search_lines_px // 2 * 2 + 1, settings.search_cols_px // 2 * 2 + 1)
    )
    brightness = np.zeros((len(pairs), blocks))
    for k, pair in enumerate(pairs):
        volumes[k] = volume(pair, blocks, settings.search_cols_px, settings.search_lines_px)
        part = pair.lead[: blocks * BLOCK_LINES]
        found = len(part) // BLOCK_LINES
        brightness[k, :found] = part[: found * BLOCK_LINES].reshape(found, -1).mean(axis=1)
    coarse = coarse_offsets(volumes, brightness)
    nearest = np.clip(np.rint((centres - block_centres(blocks)[0]) / BLOCK_LINES).astype(int), 0, blocks - 1)
    known = (volumes.max(axis=(2, 3)) > 2.0) & ~coarse.cloudy
    weight = np.where(known[:, nearest], 0.5 * _COARSE_SD_PX**-2, 1e-6)
    return coarse.offsets_px[:, nearest], weight[..., None, None] * np.eye(2)


def _refined(
    ready: list[Pictures],
    now: Smoothed,
    coarse: Floats,
    centres: Floats,
    lines: int,
    step: int,
    habits: Habits,
    last: bool,
) -> tuple[Smoothed, list[Cells], Habits]:
    """One round: cells measured along the curves, implausible ones set back, curves drawn anew."""
    at = np.arange(lines, dtype=np.float64)
    k, knots = now.own.shape[:2]
    offset, measured = coarse.copy(), np.zeros((k, knots, 2, 2))
    cells = []
    near = np.abs(now.offsets_px - coarse).max(axis=2) < _FAR_PX
    for p, given in enumerate(ready):
        cell = measure(given, _between(centres, now.offsets_px[p], at), knots, step)
        cells.append(cell)
        good = near[p, : len(cell.fit)]
        measured[p, : len(cell.fit)] = cell.information * good[:, None, None]
        found = np.flatnonzero(np.trace(measured[p], axis1=1, axis2=2) > 0)
        offset[p, found] = cell.offset_px[found]
    anchor = _ANCHOR_SD_PX**-2 * np.eye(2)
    level = _level(now, measured)
    information, factor = measured, 1.0
    for _ in range(2):
        solution = smooth(offset, information + anchor, level, habits)
        weight, factor = _plausible(offset - solution.offsets_px, measured)
        information = measured * (weight / factor)[..., None, None]
    known = np.trace(information, axis1=2, axis2=3) > 2 * _MEASURED_SD_PX**-2
    habits = learned(solution, known, habits)
    final = smooth(offset, information + anchor, level, habits, covariance=last)
    return final, cells, habits


def _level(now: Smoothed, measured: Floats) -> Floats:
    """(pairs, 2) where each pair's curves lie in the mean, by what was measured of them."""
    weight = (np.trace(measured, axis1=2, axis2=3) > 0) + 1e-6
    return np.asarray((now.offsets_px * weight[..., None]).sum(axis=1) / weight.sum(axis=1)[:, None])


def _plausible(residual: Floats, information: Floats) -> tuple[Floats, float]:
    """Weights (pairs, knots) of residuals, Cauchy's at three deviations; and the variance factor, at least 1.

    The factor is by the middle one of the squares: 2 ln 2 for two numbers of unit deviation.
    """
    square = np.einsum("kni,knij,knj->kn", residual, information, residual)
    used = square[np.trace(information, axis1=2, axis2=3) > 0]
    factor = max(float(np.median(used)) / (2 * np.log(2.0)), 1.0) if used.size else 1.0
    return 1.0 / (1.0 + square / (18.0 * factor)), factor


def _between(centres: Floats, knots_px: Floats, at: Floats) -> Floats:
    """Curves (2, n) through values (knots, 2) at the knots, level beyond the ends."""
    inside = np.clip(at, centres[0], centres[-1])
    return np.asarray(CubicSpline(centres, knots_px, axis=0)(inside)).T


def _of_pair(
    pair: RowPair,
    overlap: Overlap,
    geometry: StripGeometry,
    now: Smoothed,
    k: int,
    cells: Cells,
    centres: Floats,
    lines: int,
) -> PairOffsets:
    """A pair's curves as offsets of its left strip's lines."""
    assert now.covariance is not None
    n = len(overlap.left)
    u = np.arange(lines, dtype=np.float64)
    curve = _between(centres, now.offsets_px[k], u)
    at = left_lines(pair, curve[1], n)
    col, line = of_left(pair, geometry, at, curve)
    sd = np.sqrt(np.maximum(np.diagonal(now.covariance[k], axis1=1, axis2=2), 0.0) + _RESAMPLING_SD_PX**2)
    sd_col, sd_line = (np.interp(at, centres, sd[:, axis]) for axis in (0, 1))
    own = np.zeros(len(centres), dtype=bool)
    own[: len(cells.fit)] = (cells.fit >= 0.25) & (np.trace(cells.information, axis1=1, axis2=2) > 0)
    return PairOffsets(
        k_of(overlap), col, line, sd_col, sd_line, _labels(own, centres, at, np.maximum(sd_col, sd_line))
    )


def k_of(overlap: Overlap) -> int:
    return overlap.pair


def _labels(own: Flags, centres: Floats, at: Floats, sd_px: Floats) -> np.ndarray:
    step = centres[1] - centres[0]
    nearest = np.clip(np.rint((at - centres[0]) / step).astype(int), 0, len(centres) - 1)
    outside = (at < -step) | (at > centres[-1] + step)
    label = np.where(own[nearest] & (sd_px <= _MEASURED_SD_PX), MEASURED, BRIDGED)
    label[(sd_px > _RELIABLE_SD_PX) | outside] = UNRELIABLE
    return label.astype(np.uint8)


def _nothing(overlap: Overlap) -> PairOffsets:
    n = len(overlap.left)
    zero, far = np.zeros(n), np.full(n, 10.0)
    return PairOffsets(overlap.pair, zero, zero, far, far, np.full(n, UNRELIABLE, dtype=np.uint8))
