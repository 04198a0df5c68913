"""Whether what was measured is of one layer: low clouds as dark as the ground leave steps.

Ground that two pairs see may go apart by relief, slowly, or where lines were lost, for good. A cloud's edge
moves one pair against the others within some lines, by wind and height; where it moves all, they break
off the way they went.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy.ndimage import uniform_filter1d

from geomosaic.ccd.expected import Expected
from geomosaic.ccd.model import Flags, Floats

_BESIDE_KNOTS = 4
# So far may the middles of both sides lie apart: more lines hide what happens between.
_MOST_APART_KNOTS = 24
_LEAST_PX, _LOST_PX = 0.5, 0.7
_MOST_SPREAD = 0.3
# A curve alone: knots of a straight piece, how far from straight, how far the next one may be.
_PIECE_KNOTS, _STRAIGHT_PX, _MOST_AHEAD_KNOTS = 3, 0.15, 12
_LEAST_BREAK_PX, _BREAK_DEVIATIONS, _LEAST_SD_PX = 0.6, 6.0, 0.03


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
    sd = np.maximum(1.4826 * np.median(miss[near], axis=0), _LEAST_SD_PX)
    most = np.maximum(_LEAST_BREAK_PX, _BREAK_DEVIATIONS * sd * (apart[:, None] / size) ** 3)
    found = asked & (miss > most).any(axis=1)
    return float(np.hypot(*miss[found].T).max(initial=0.0))
