"""Whether what was measured is of one layer: low clouds as dark as the ground leave steps.

Ground that two pairs see may go apart by relief, slowly, or where lines were lost, for good. A cloud's edge
moves one pair against the others within some lines, by wind and height; where it moves all, they break
off the way they went.
"""

from __future__ import annotations

from itertools import combinations
from typing import Final

import numpy as np
from scipy.ndimage import uniform_filter1d

from geomosaic.ccd.expected import Expected
from geomosaic.ccd.model import Flags, Floats
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned

_COMPUTED: Final = (
    "chosen; figures computed with simulate.strip_plan.StripPlan: 4 CCDs, 8192 lines, seed 1, with 900 m of "
    "relief and at a contrast of 2 %"
)
_BESIDE_KNOTS = sourced(
    4,
    "knots",
    "on either side of a step, whose medians are compared: of fewer, single wrong knots make steps, "
    "with more, a cloud's edge and its end fall into one side",
    "chosen in commit 85d59ff, 5 before",
)
_MOST_APART_KNOTS = tuned(
    24,
    "knots",
    "that the middles of both sides may lie apart, and half as many that steps keep from lost lines: "
    "more lines hide what happens between, with fewer, a step in a gap goes unseen",
)
_LEAST_PX = sourced(
    0.5,
    "px",
    "by which two pairs must go apart, beyond what the steepest ground makes: over ground they do by "
    "0.1 px, by 0.26 at low contrast; with less, good scenes are doubted, with more, low clouds in slow "
    "wind are believed",
    _COMPUTED,
)
_LOST_PX = tuned(
    0.7,
    "lines",
    "by which what is known of dline changes from knot to knot where lines were lost, one at least: "
    "with less, a DEM's relief is taken for lost lines and steps there are not looked for, with more, "
    "steps at lost lines are taken for clouds",
)
_MOST_SPREAD = sourced(
    0.3,
    "share of the step's length",
    "by which each side may spread about its median: it is 0.03 px over ground, 0.12 at low contrast; "
    "with more, unrest makes steps, with less, steps of half a pixel are lost at low contrast",
    _COMPUTED,
)
_PIECE_KNOTS = tuned(
    3,
    "knots",
    "of a piece of a curve by itself: two for its slope and the middle one to see whether it is "
    "straight; the code takes the middle one by its number",
)
_STRAIGHT_PX = sourced(
    0.15,
    "px",
    "by which a piece's middle knot may lie off its ends' line: of 99 % it is 0.06 px, 0.21 at low "
    "contrast; with more, pieces that noise tilts miss the next ones, with less, few are left to ask",
    _COMPUTED,
)
_MOST_AHEAD_KNOTS = sourced(
    12,
    "knots",
    "from the middle of a piece to the next one's: what a smooth curve may miss by has grown 64-fold "
    "there, beyond any cloud's step",
    "(12 / 3)^3, the third power of the distance",
)
_LEAST_BREAK_PX = sourced(
    0.6,
    "px",
    "by which two pieces must miss each other: over ground they do by 0.11 px at most, by 0.35 at low "
    "contrast; with less, good scenes are doubted, with more, low clouds are believed",
    _COMPUTED,
)
_BREAK_DEVIATIONS = tuned(
    6.0,
    "deviations of neighbouring pieces' misses",
    "by which two pieces must miss each other, too: with less, jitter breaks curves by itself, with "
    "more, clouds are believed where the platform is restless",
)
_LEAST_SD_PX = sourced(
    0.03,
    "px",
    "least deviation of those misses, about what they have over ground (0.03 to 0.04 px): with less, "
    "curves that are still would break by what resampling leaves, with more, breaks farther ahead go "
    "unseen",
    _COMPUTED,
)


def widest_step(offset_px: Floats, own: Flags, known_px: Floats, likely: Expected) -> float:
    """The largest step (px) of a pair, against another or alone, that no ground makes; 0 if there is none.

    Args: offset_px (pairs, knots, 2) measured at knots where own (pairs, knots). known_px (pairs, knots): of
    dline, beforehand; where lines were lost in any pair no other steps are looked for.
    """
    lost = (np.abs(np.diff(known_px, axis=1, prepend=known_px[:, :1])) > _LOST_PX).any(axis=0)
    own = own & (uniform_filter1d(lost.astype(np.float64), _MOST_APART_KNOTS + 1) < 1e-9)
    steps = [
        _against(offset_px[[p, q]], own[p] & own[q], likely) for p, q in combinations(range(len(own)), 2)
    ]
    steps += [_broken(mine, np.flatnonzero(good)) for mine, good in zip(offset_px, own, strict=True)]
    return max(steps, default=0.0)


def _against(offset_px: Floats, both: Flags, likely: Expected) -> float:
    """The largest step of one pair against another (2, knots, 2), from knots before to as many after."""
    knots = np.flatnonzero(both)
    if len(knots) < 2 * _BESIDE_KNOTS:
        return 0.0
    apart_px = offset_px[0, knots] - offset_px[1, knots]
    sides = np.lib.stride_tricks.sliding_window_view(apart_px, _BESIDE_KNOTS, axis=0)
    middle = np.median(sides, axis=2)
    spread = np.abs(sides - middle[..., None]).mean(axis=2).max(axis=1)
    at = np.lib.stride_tricks.sliding_window_view(knots, _BESIDE_KNOTS)[:, _BESIDE_KNOTS // 2]
    step = np.abs(middle[_BESIDE_KNOTS:] - middle[:-_BESIDE_KNOTS])
    apart = at[_BESIDE_KNOTS:] - at[:-_BESIDE_KNOTS]
    unrest = np.maximum(spread[_BESIDE_KNOTS:], spread[:-_BESIDE_KNOTS])
    relief = np.outer(apart * likely.knot_lines * likely.steepest_px_per_line, [0.0, 1.0])
    length = np.hypot(*step.T)
    found = (step > _LEAST_PX + relief).any(axis=1) & (apart <= _MOST_APART_KNOTS)
    found &= unrest < _MOST_SPREAD * length
    return float(length[found].max(initial=0.0))


def _broken(offset_px: Floats, knots: np.ndarray) -> float:
    """The largest break of a pair's curve (knots, 2): how far two straight pieces miss each other half way.

    A smooth curve's pieces miss by the third power of their distance; how much at the least is the curve's.
    """
    size = _PIECE_KNOTS
    if len(knots) < 2 * size:
        return 0.0
    pieces = np.lib.stride_tricks.sliding_window_view(offset_px[knots], size, axis=0)
    at = np.lib.stride_tricks.sliding_window_view(knots, size)
    slope = (pieces[..., -1] - pieces[..., 0]) / (size - 1)
    bent = np.abs(pieces[..., 1] - 0.5 * (pieces[..., 0] + pieces[..., -1])).max(axis=1)
    whole = (at[:, -1] - at[:, 0] == size - 1) & (bent < _STRAIGHT_PX)
    middle, before, after = pieces.mean(axis=2), slice(0, -size), slice(size, None)
    apart = (at[after, 1] - at[before, 1]).astype(np.float64)
    miss = np.abs(middle[after] - middle[before] - 0.5 * apart[:, None] * (slope[after] + slope[before]))
    asked = whole[after] & whole[before] & (apart <= _MOST_AHEAD_KNOTS)
    near = asked & (apart == size)
    if near.sum() < 2 * size:
        return 0.0
    sd = np.maximum(NORMAL_PER_MAD * np.median(miss[near], axis=0), _LEAST_SD_PX)
    most = np.maximum(_LEAST_BREAK_PX, _BREAK_DEVIATIONS * sd * (apart[:, None] / size) ** 3)
    found = asked & (miss > most).any(axis=1)
    return float(np.hypot(*miss[found].T).max(initial=0.0))
