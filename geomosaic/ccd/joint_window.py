"""A window of lines of all pairs solved at once: curves at knots, their deviations, what was measured itself.

Correlation volumes give the way to about a pixel (`paths`). Least squares matching of small cells refines it
(`least_squares_matching`), and a smoother (`motion`) draws the curves and bridges what clouds hide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Self

import numpy as np
from scipy.ndimage import uniform_filter1d

from geomosaic.arrays import Bools, Floats
from geomosaic.ccd.brightness import CELL_PX, of_one_response
from geomosaic.ccd.expected import Expected
from geomosaic.ccd.interpolation_sd import between_knots_variance
from geomosaic.ccd.least_squares_matching import (
    MISFIT_PX,
    NEARBY_KNOTS,
    KnotOffsetsMeasured,
    measure,
    pair_images,
    seen_near,
)
from geomosaic.ccd.model import SURE_SD_PX, UNKNOWN_SD_PX, CcdSettings
from geomosaic.ccd.motion import MotionPriors, Smoothed, first_priors, learned, smooth, smooth_with_shift
from geomosaic.ccd.parallel import each
from geomosaic.ccd.paths import block_centres, coarse_offsets
from geomosaic.ccd.prepared_pairs import PreparedPairs, curve_of
from geomosaic.ccd.rows import RowPair
from geomosaic.ccd.second_layers import widest_step
from geomosaic.ccd.volumes import BLOCK_LINES, volume
from geomosaic.constants import FOUR_SIGMA, tuned
from geomosaic.estimation.robust import THREE_SIGMA

_COARSE_SD_PX = tuned(1.2, "px", "of the path through bins of 2 px: less follows each bin; more the prior")
_ANCHOR: Final = (FOUR_SIGMA * UNKNOWN_SD_PX) ** -2 * np.eye(2)
"""Keeps knots that nothing was measured at from running off."""
_FAR_PX: Final = THREE_SIGMA * _COARSE_SD_PX
"""Off the path: rather a cloud."""
_UNSEEN_PX = tuned(0.1, "px", "deviation of that offset: more admits clouds; less loses bright ground")
_KNOTS_PER_FACT = tuned(10.0, "knots", "that err alike: fewer make still ground move; more decide nothing")
_LEAST_FIT = tuned(0.25, "share", "of cells that fit, suspect pixels that mix a knot: more loses half clouds")
_LASTING_SHARE = tuned(0.05, "share", "of a knot's variance that is correlated: less claims too much")
_ROUNDS = tuned(
    ((2, 3), (1, 2)),
    "px a pixel, rounds",
    "of refinement: fewer leave a part of 3 px; more take time",
)
LEAST_KNOTS = tuned(16, "knots", "of a pair: fewer may be mostly one cloud's; more refuse short scenes")


@dataclass(frozen=True)
class KnotOffsets:
    """offset_px, sd_px: (pairs, knots, 2) dcol, dline, trailing minus leading. own: (pairs, knots) what was
    measured there itself, 0 to 1."""

    offset_px: Floats
    sd_px: Floats
    own: Floats

    @classmethod
    def nothing(cls, pairs: int, knots: int) -> Self:
        return cls(np.zeros((pairs, knots, 2)), np.zeros((pairs, knots, 2)), np.zeros((pairs, knots)))

    def widened(self, by_px: float) -> KnotOffsets:
        """The same as not measured, with by_px added to the standard deviations."""
        return KnotOffsets(self.offset_px, np.hypot(self.sd_px, by_px), np.zeros_like(self.own))

    def add(self, part: KnotOffsets, first: int, weight: Floats) -> None:
        """Adds a part that begins at knot `first`, each knot by its weight (in place)."""
        at = slice(first, first + len(weight))
        self.offset_px[:, at] += part.offset_px * weight[:, None]
        self.sd_px[:, at] += part.sd_px * weight[:, None]
        self.own[:, at] += part.own * weight


@dataclass(frozen=True)
class WindowStart:
    """Offsets (pairs, knots, 2), their information (pairs, knots, 2, 2); pixels (n, w) of each pair that may
    be cloud, none where nothing is."""

    offset_px: Floats
    information: Floats
    suspect: list[Bools]

    def clear(self, pairs: Sequence[RowPair]) -> list[RowPair]:
        """The pairs without what may be cloud."""
        if not self.suspect:
            return list(pairs)
        return [replace(p, valid=p.valid & ~hidden) for p, hidden in zip(pairs, self.suspect, strict=True)]


def solved_window(
    pairs: Sequence[RowPair], start: WindowStart, likely: Expected
) -> tuple[KnotOffsets, list[RowPair]]:
    """Offsets of all pairs, which have equally many lines, beyond what is known of them beforehand.

    Returns also the pairs, less the pixels that turned out to be clouds. Where no knot of any pair is
    measured, as without texture, the curves are a guess and their deviations unknown.
    """
    centres = _centres(pairs, likely)
    coarse, weights = start.offset_px, start.information
    priors = first_priors(likely)
    now = smooth(coarse, weights, np.median(coarse, axis=1), priors)
    cells: list[KnotOffsetsMeasured] = []
    cloudy = False
    clear = list(pairs)
    used: Bools = np.zeros(coarse.shape[:2], dtype=np.bool_)
    for scale, rounds in _ROUNDS:
        clear = list(pairs)
        images = each(partial(pair_images, scale=scale), pairs)
        ready = PreparedPairs(pairs, images, coarse, centres)
        if start.suspect:
            off, seen = _off_curves(ready, now, start.suspect, priors)
            cloudy |= off
            if cloudy or not seen:
                clear = start.clear(pairs)
                ready = replace(ready, images=each(partial(pair_images, scale=scale), clear))
        for turn in range(rounds):
            last = scale == 1 and turn == rounds - 1
            now, cells, used, priors = _refined(ready, now, priors, last)
    assert now.covariance is not None
    variance = np.maximum(np.diagonal(now.covariance, axis1=2, axis2=3), 0.0)
    measured_px = np.stack([c.offset_px for c in cells])
    information = np.stack([np.diagonal(c.information, axis1=1, axis2=2) for c in cells])
    nearby = uniform_filter1d(
        information * np.stack([c.scatter for c in cells])[..., None], NEARBY_KNOTS, axis=1
    )
    variance = variance + np.where(used[..., None], _LASTING_SHARE / np.maximum(nearby, 1e-9), 0.0)
    if likely.knot_lines > likely.jitter_lines:
        variance = variance + between_knots_variance(ready, now.offsets_px, used, likely.jitter_lines)
    sd_px = np.maximum(information, np.diag(_ANCHOR)) ** -0.5
    own: Bools = np.stack([c.fit >= _LEAST_FIT for c in cells]) & used
    own &= seen_near(information * own[..., None], SURE_SD_PX)
    found = KnotOffsets(now.offsets_px, np.sqrt(variance), own.astype(np.float64))
    known_px = np.stack([pair.known_px[np.rint(centres).astype(int)] for pair in pairs])
    sure = own & (found.sd_px.max(axis=2) <= SURE_SD_PX)
    step = widest_step(measured_px, sd_px, own, known_px, likely) if sure.any() else UNKNOWN_SD_PX
    return found.widened(step) if step else found, clear


def _centres(pairs: Sequence[RowPair], likely: Expected) -> Floats:
    step = likely.knot_lines
    return np.asarray(np.arange(len(pairs[0]) // step) * float(step) + (step - 1) / 2)


def first_offsets(pairs: Sequence[RowPair], settings: CcdSettings, likely: Expected) -> WindowStart:
    """Offsets to about a pixel, from correlation volumes."""
    centres = _centres(pairs, likely)
    blocks = max(len(pairs[0]) // BLOCK_LINES, 1)

    def evidence(pair: RowPair) -> Floats:
        return volume(pair, blocks, settings)

    volumes = np.stack(each(evidence, pairs))
    rows = blocks * BLOCK_LINES
    cells = rows // CELL_PX
    alike = of_one_response([p.grey[p.to_left_right] for p in pairs])
    greys = [grey[p.to_left_right] for grey, p in zip(alike, pairs, strict=True)]
    brightness = np.stack([_block_means(grey[0, :cells], blocks) for grey in greys])
    coarse = coarse_offsets(volumes, brightness, likely)
    nearest = np.clip(np.rint((centres - block_centres(blocks)[0]) / BLOCK_LINES).astype(int), 0, blocks - 1)
    known = volumes.max(axis=(2, 3)) > 2.0
    weight = np.where(known[:, nearest], 0.5 * _COARSE_SD_PX**-2, 1e-6)
    suspect = []
    if coarse.suspect:
        hidden = zip(greys, pairs, strict=True)
        suspect = [coarse.suspect.pixels(grey, p.valid.shape) for grey, p in hidden]
    return WindowStart(coarse.offsets_px[:, nearest], weight[..., None, None] * np.eye(2), suspect)


def _block_means(grey: Floats, blocks: int) -> Floats:
    """Mean greys of blocks of lines by cells (h, w), NaN where less than half are known."""
    cells = grey.reshape(blocks, -1)
    known = np.isfinite(cells)
    sums = np.where(known, cells, 0.0).sum(axis=1)
    return np.where(known.mean(axis=1) >= 0.5, sums / np.maximum(known.sum(axis=1), 1), np.nan)


def _off_curves(
    ready: PreparedPairs, now: Smoothed, suspect: Sequence[Bools], priors: MotionPriors
) -> tuple[bool, bool]:
    """Whether the suspect part lies off the curves that the rest draws; and whether that can be decided."""
    cells, offset, measured = _measured(ready, now)
    centres = ready.centres
    step = round(centres[1] - centres[0])
    rows = len(centres) * step
    share = np.stack([hidden[:rows].reshape(len(centres), -1).mean(axis=1) for hidden in suspect])
    found = np.trace(measured, axis1=2, axis2=3) > 0
    part, rest = share > 1.0 - _LEAST_FIT, share < _LEAST_FIT
    measured = np.where((part | rest)[..., None, None], measured, 0.0)
    fits = np.stack([c.fit >= _LEAST_FIT for c in cells]) & found
    if not part.any() or fits[part].mean() < _LEAST_FIT:
        return False, False
    level = _level(offset, found & rest, now)
    weighed = measured
    for _ in range(3):
        solution, shift, covariance = smooth_with_shift(
            offset, weighed + _ANCHOR, part & found, level, priors
        )
        residual = offset - solution.offsets_px - np.where(part[..., None], shift, 0.0)
        weight, factor = _plausible(residual, measured)
        weighed = measured * (weight / factor[:, None])[..., None, None]
    sd = np.sqrt(np.diagonal(covariance) * _KNOTS_PER_FACT)
    off = np.abs(shift) > np.maximum(FOUR_SIGMA * sd, MISFIT_PX)
    return bool(off.any()), bool((sd < _UNSEEN_PX).all())


def _refined(
    ready: PreparedPairs, now: Smoothed, priors: MotionPriors, last: bool
) -> tuple[Smoothed, list[KnotOffsetsMeasured], Bools, MotionPriors]:
    """One round: cells measured along the curves, implausible ones set back, curves drawn anew.

    Returns: curves, cells, which of them (pairs, knots) had a say, priors.
    """
    cells, offset, measured = _measured(ready, now)
    found = np.trace(measured, axis1=2, axis2=3) > np.trace(_ANCHOR)
    level = _level(offset, found, now)
    close = np.where(found[..., None, None], np.stack([cell.close for cell in cells]), 0.0)
    information, near_by = measured, close
    for _ in range(2):
        solution = smooth(offset, near_by + _ANCHOR, level, priors)
        weight, factor = _plausible(offset - solution.offsets_px, measured)
        share = (weight / factor[:, None])[..., None, None]
        information, near_by = measured * share, close * share
    known = np.trace(information, axis1=2, axis2=3) > 2 * SURE_SD_PX**-2
    priors = learned(solution, known, priors)
    final = smooth(offset, information + _ANCHOR, level, priors, covariance=last)
    return final, cells, found, priors


def _measured(ready: PreparedPairs, now: Smoothed) -> tuple[list[KnotOffsetsMeasured], Floats, Floats]:
    """Cells along the curves, their offsets (the coarse ones where there are none) and their information."""
    centres, coarse = ready.centres, ready.coarse_px
    step = round(centres[1] - centres[0])
    at = np.arange(len(centres) * step, dtype=np.float64)

    def measured_cells(k: int) -> KnotOffsetsMeasured:
        curve = curve_of(centres, now.offsets_px[k], at)
        return measure(ready.images[k], curve, ready.pairs[k].known_px[: len(at)], step)

    cells = each(measured_cells, range(len(ready.pairs)))
    near: Bools = np.abs(now.offsets_px - coarse).max(axis=2) < _FAR_PX
    information = np.stack([cell.information for cell in cells]) * near[..., None, None]
    found = np.trace(information, axis1=2, axis2=3) > np.trace(_ANCHOR)
    return (
        cells,
        np.where(found[..., None], np.stack([cell.offset_px for cell in cells]), coarse),
        information,
    )


def _level(offset_px: Floats, found: Bools, now: Smoothed) -> Floats:
    """(pairs, 2) about where each pair's curves lie: by what was measured, or by the curves if little was."""
    return np.stack(
        [
            np.median(measured[good], axis=0) if good.sum() >= LEAST_KNOTS else curve.mean(axis=0)
            for measured, good, curve in zip(offset_px, found, now.offsets_px, strict=True)
        ]
    )


def _plausible(residual: Floats, information: Floats) -> tuple[Floats, Floats]:
    """Weights (pairs, knots) of residuals, Cauchy's at three deviations; variance factors (pairs,).

    A factor, at least 1, is by the middle one of the squares: 2 ln 2 for two numbers of unit deviation.
    """
    square = np.einsum("kni,knij,knj->kn", residual, information, residual)
    used = np.trace(information, axis1=2, axis2=3) > 0
    middle = [
        float(np.median(mine[good])) if good.any() else 0.0 for mine, good in zip(square, used, strict=True)
    ]
    factor = np.maximum(np.array(middle) / (2 * np.log(2.0)), 1.0)
    return 1.0 / (1.0 + square / (18.0 * factor[:, None])), factor
