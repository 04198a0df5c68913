"""Whether what was measured is of one layer: low clouds as dark as the ground leave steps.

Ground that two pairs see may go apart by relief, slowly, or where lines were lost, for good. A cloud's edge
moves one pair against the others within some lines, by wind and height; where it moves all, they break
off the way they went.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy.ndimage import uniform_filter1d

from geomosaic.arrays import Bools, Floats
from geomosaic.ccd.expected import LEAST_STEP_PX, NOISE_SHARE, Expected
from geomosaic.ccd.model import LOCKING_SD_PX
from geomosaic.constants import NORMAL_PER_MAD, SIX_SIGMA, tuned

_SIDE_KNOTS = tuned(4, "knots", "each side of a step: fewer find stray knots; more blur a cloud's edge")
_MOST_APART_KNOTS = tuned(24, "knots", "between two sides or pieces: fewer miss gaps; more hide motion")


def widest_step(offset_px: Floats, sd_px: Floats, own: Bools, known_px: Floats, likely: Expected) -> float:
    """The largest step (px) of a pair, against another or alone, that no ground makes; 0 if there is none.

    Args: offset_px, sd_px (pairs, knots, 2) measured at knots where own (pairs, knots), and their deviations.
    known_px (pairs, knots): of dline, beforehand; where lines were lost in any pair no other steps are looked
    for.
    """
    lost = (np.abs(np.diff(known_px, axis=1, prepend=known_px[:, :1])) > 0.5).any(axis=0)
    own = own & (uniform_filter1d(lost.astype(np.float64), _MOST_APART_KNOTS + 1) < 1e-9)
    steps = [
        _against(offset_px[[p, q]], sd_px[[p, q]], own[p] & own[q], likely)
        for p, q in combinations(range(len(own)), 2)
    ]
    steps += [
        _broken(mine[good], sd[good], np.flatnonzero(good))
        for mine, sd, good in zip(offset_px, sd_px, own, strict=True)
    ]
    return max(steps, default=0.0)


def _against(offset_px: Floats, sd_px: Floats, both: Bools, likely: Expected) -> float:
    """The largest step of one pair against another (2, knots, 2), from knots before to as many after."""
    knots = np.flatnonzero(both)
    if len(knots) < 2 * _SIDE_KNOTS:
        return 0.0
    apart_px = offset_px[0, knots] - offset_px[1, knots]
    sides = np.lib.stride_tricks.sliding_window_view(apart_px, _SIDE_KNOTS, axis=0)
    middle = np.median(sides, axis=2)
    spread = np.abs(sides - middle[..., None]).mean(axis=2).max(axis=1)
    at = np.lib.stride_tricks.sliding_window_view(knots, _SIDE_KNOTS)[:, _SIDE_KNOTS // 2]
    step = np.abs(middle[_SIDE_KNOTS:] - middle[:-_SIDE_KNOTS])
    apart = at[_SIDE_KNOTS:] - at[:-_SIDE_KNOTS]
    noise_px = np.maximum(spread[_SIDE_KNOTS:], spread[:-_SIDE_KNOTS])
    relief = np.outer(apart * likely.knot_lines * likely.steepest_px_per_line, [0.0, 1.0])
    length = np.hypot(*step.T)
    sd = _middle_sd(np.hypot(*sd_px[:, knots]))
    least_px = np.maximum(LEAST_STEP_PX, SIX_SIGMA * np.hypot(sd[_SIDE_KNOTS:], sd[:-_SIDE_KNOTS]))
    found = (step > least_px + relief).any(axis=1) & (apart <= _MOST_APART_KNOTS)
    found &= noise_px < NOISE_SHARE * length
    return float(length[found].max(initial=0.0))


def _middle_sd(sd_px: Floats) -> Floats:
    """Deviations of the middle one of each side's knots: by sqrt(pi / 2) larger than their mean's."""
    sides = np.lib.stride_tricks.sliding_window_view(sd_px**2, _SIDE_KNOTS, axis=0)
    return np.asarray(np.sqrt(np.pi / 2 * sides.mean(axis=-1) / _SIDE_KNOTS))


def _broken(offset_px: Floats, sd_px: Floats, knots: np.ndarray) -> float:
    """The largest break of a pair's curve at its knots (n, 2): how far two straight pieces miss each other.

    A smooth curve's pieces miss by the third power of their distance; how much at the least is the curve's.
    """
    size = 3  # a middle knot shows whether two others make a slope
    if len(knots) < 2 * size:
        return 0.0
    pieces = np.lib.stride_tricks.sliding_window_view(offset_px, size, axis=0)
    at = np.lib.stride_tricks.sliding_window_view(knots, size)
    slope = (pieces[..., -1] - pieces[..., 0]) / (size - 1)
    bent = np.abs(pieces[..., 1] - 0.5 * (pieces[..., 0] + pieces[..., -1])).max(axis=1)
    whole = (at[:, -1] - at[:, 0] == size - 1) & (bent < NOISE_SHARE * LEAST_STEP_PX)
    middle, before, after = pieces.mean(axis=2), slice(0, -size), slice(size, None)
    apart = (at[after, 1] - at[before, 1]).astype(np.float64)
    miss = np.abs(middle[after] - middle[before] - 0.5 * apart[:, None] * (slope[after] + slope[before]))
    asked = whole[after] & whole[before] & (apart <= _MOST_APART_KNOTS)
    near = asked & (apart == size)
    if near.sum() < 2 * size:
        return 0.0
    sd = np.maximum(NORMAL_PER_MAD * np.median(miss[near], axis=0), LOCKING_SD_PX)
    most = np.maximum(LEAST_STEP_PX, SIX_SIGMA * sd * (apart[:, None] / size) ** 3)
    variance = np.lib.stride_tricks.sliding_window_view(sd_px**2, size, axis=0).mean(axis=2)
    chance = (variance[after] + variance[before]) * (1.0 / size + 0.125 * apart[:, None] ** 2)
    most = np.maximum(most, SIX_SIGMA * np.sqrt(chance))
    found = asked & (miss > most).any(axis=1)
    return float(np.hypot(*miss[found].T).max(initial=0.0))
