"""All pairs at once: one motion for all, an own slow part for each, clouds set aside (method `joint`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from geomosaic.ccd.least_squares_matching import Cells, Pictures, measure, pictures
from geomosaic.ccd.model import BRIDGED, MEASURED, UNRELIABLE, Flags, Floats, Overlap, PairOffsets, Settings
from geomosaic.ccd.motion import FIRST_HABITS, Habits, Smoothed, learned, smooth
from geomosaic.ccd.paths import block_centres, coarse_offsets
from geomosaic.ccd.rows import RowPair, left_lines, of_left, row_pair, shared_length
from geomosaic.ccd.volumes import BLOCK_LINES, volume
from geomosaic.survey.strips import StripGeometry

_COARSE_SD_PX = 1.2
_MEASURED_SD_PX = 0.25
_RELIABLE_SD_PX = 0.6


def joint(
    overlaps: Sequence[Overlap], geometry: StripGeometry, settings: Settings
) -> tuple[PairOffsets, ...]:
    """Offsets of every line of every pair, with standard deviations.

    The overlaps are seen from their leading strips (`rows`); correlation volumes give the way to about a pixel
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
    offsets, weights = _start(pairs, lines, centres, settings)
    now = smooth(offsets, weights, FIRST_HABITS)
    habits = FIRST_HABITS
    cells: list[Cells] = []
    for scale, rounds in ((2, 2), (1, 2)):
        ready = [pictures(pair, scale) for pair in pairs]
        for turn in range(rounds):
            last = scale == 1 and turn == rounds - 1
            now, cells, habits = _refined(ready, now, centres, lines, step, habits, last)
    return tuple(
        _of_pair(pair, overlap, geometry, now, k, cells[k], centres, lines)
        for k, (pair, overlap) in enumerate(zip(pairs, overlaps, strict=True))
    )


def _start(
    pairs: list[RowPair], lines: int, centres: Floats, settings: Settings
) -> tuple[Floats, Floats]:
    """Offsets and their information at the knots, from correlation volumes."""
    blocks = max(lines // BLOCK_LINES, 1)
    volumes = np.zeros((len(pairs), blocks, settings.search_lines_px // 2 * 2 + 1, settings.search_cols_px // 2 * 2 + 1))
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
    ready: list[Pictures], now: Smoothed, centres: Floats, lines: int, step: int, habits: Habits, last: bool
) -> tuple[Smoothed, list[Cells], Habits]:
    """One round: cells measured along the curves, implausible ones set back, curves drawn anew."""
    at = np.arange(lines, dtype=np.float64)
    k, knots = now.own.shape[:2]
    offset, information = np.zeros((k, knots, 2)), np.zeros((k, knots, 2, 2))
    cells = []
    for p, given in enumerate(ready):
        curve = _between(centres, now.offsets_px[p], at)
        cell = measure(given, curve, knots, step)
        cells.append(cell)
        offset[p, : len(cell.fit)], information[p, : len(cell.fit)] = cell.offset_px, cell.information
    for _ in range(2):
        solution = smooth(offset, information, habits)
        information = information * _plausible(offset - solution.offsets_px, information)[..., None, None]
    known = np.trace(information, axis1=2, axis2=3) > 2 * _MEASURED_SD_PX**-2
    habits = learned(solution, known, habits)
    return smooth(offset, information, habits, covariance=last), cells, habits


def _plausible(residual: Floats, information: Floats) -> Floats:
    """Weights (pairs, knots) of residuals in units of their deviation: Cauchy's, at three of the middle ones."""
    size = np.sqrt(np.einsum("kni,knij,knj->kn", residual, information, residual) / 2)
    used = size[np.trace(information, axis1=2, axis2=3) > 0]
    scale = max(float(np.median(used)) * 1.2, 0.3) if used.size else 1.0
    return 1.0 / (1.0 + (size / (3.0 * scale)) ** 2)


def _between(centres: Floats, knots_px: Floats, at: Floats) -> Floats:
    """Curves (2, n) through values (knots, 2) at the knots, level beyond the ends."""
    inside = np.clip(at, centres[0], centres[-1])
    return np.asarray(CubicSpline(centres, knots_px, axis=0)(inside)).T


def _of_pair(
    pair: RowPair, overlap: Overlap, geometry: StripGeometry, now: Smoothed, k: int, cells: Cells, centres: Floats, lines: int
) -> PairOffsets:
    """A pair's curves as offsets of its left strip's lines."""
    assert now.covariance is not None
    n = len(overlap.left)
    u = np.arange(lines, dtype=np.float64)
    curve = _between(centres, now.offsets_px[k], u)
    at = left_lines(pair, curve[1], n)
    col, line = of_left(pair, geometry, at, curve)
    sd = np.sqrt(np.maximum(np.diagonal(now.covariance[k], axis1=1, axis2=2), 0.0))
    sd_col, sd_line = (np.interp(at, centres, sd[:, axis]) for axis in (0, 1))
    own = np.zeros(len(centres), dtype=bool)
    own[: len(cells.fit)] = (cells.fit >= 0.25) & (np.trace(cells.information, axis1=1, axis2=2) > 0)
    return PairOffsets(k_of(overlap), col, line, sd_col, sd_line, _labels(own, centres, at, np.maximum(sd_col, sd_line)))


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
