"""The motion shared by all pairs and each pair's own part, from what was measured at knots: a Gaussian smoother.

Unknowns at every knot: the motion b and one own part p per pair, columns and lines each; a pair measures
b + p. What can be expected of a curve between measurements is learned from the scene itself: an
autoregression, of some order for the motion, whose jitter is a few nearly pure tones, and of a low one for the own
parts (drift angle, mounting, relief). The normal equations are sparse along the strip and solved by Cholesky.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_matrix

from geomosaic.adjustment.block_tridiagonal import BlockTridiagonal
from geomosaic.ccd.model import Floats

_OWN_PX = 20.0
_MOTION_PX = 50.0


@dataclass(frozen=True)
class Curve:
    """A linear prediction of a curve's knot from the ones before: weights (order,), deviation of what is left."""

    weights: Floats
    sd_px: float


@dataclass(frozen=True)
class Habits:
    """What is expected of the curves: of motion and own parts, columns and lines each."""

    motion: tuple[Curve, Curve]
    own: tuple[Curve, Curve]


@dataclass(frozen=True)
class Smoothed:
    """motion (knots, 2) and own (pairs, knots, 2) in px; covariance (pairs, knots, 2, 2) of their sums."""

    motion: Floats
    own: Floats
    covariance: Floats | None

    @property
    def offsets_px(self) -> Floats:
        return self.motion[None] + self.own


STRAIGHT = np.array([2.0, -1.0])
FIRST_HABITS = Habits(
    (Curve(STRAIGHT, 0.15), Curve(STRAIGHT, 0.15)), (Curve(STRAIGHT, 0.004), Curve(STRAIGHT, 0.01))
)


def smooth(offset_px: Floats, information: Floats, habits: Habits, covariance: bool = False) -> Smoothed:
    """The most probable curves.

    Args: offset_px (pairs, knots, 2) measured, information (pairs, knots, 2, 2) its inverse covariance.
    """
    k, n = offset_px.shape[:2]
    size = 2 * (k + 1)
    diagonal = np.zeros((n, size, size))
    right = np.zeros((n, size))
    pulled = np.einsum("knij,knj->kni", information, offset_px)
    diagonal[:, :2, :2] = information.sum(axis=0)
    right[:, :2] = pulled.sum(axis=0)
    for p in range(k):
        mine = slice(2 + 2 * p, 4 + 2 * p)
        diagonal[:, mine, mine] = diagonal[:, :2, mine] = diagonal[:, mine, :2] = information[p]
        right[:, mine] = pulled[p]
    spread = np.array([_MOTION_PX] * 2 + [_OWN_PX] * (2 * k))
    diagonal[:, np.arange(size), np.arange(size)] += spread**-2 / n
    bands = _bands(habits, n, k)
    factor = BlockTridiagonal(_matrix(diagonal, bands))
    x = factor.solve(right.reshape(-1, 1)).reshape(n, k + 1, 2)
    sums = None
    if covariance:
        whole = factor.inverse_blocks().reshape(n, k + 1, 2, k + 1, 2)
        sums = np.stack(
            [
                whole[:, 0, :, 0] + whole[:, p, :, p] + whole[:, 0, :, p] + whole[:, p, :, 0]
                for p in range(1, k + 1)
            ]
        )
    return Smoothed(x[:, 0], np.moveaxis(x[:, 1:], 1, 0), sums)


def learned(solution: Smoothed, known: Floats, before: Habits) -> Habits:
    """Habits of the curves of a solution, from where they were well measured.

    Args: known (pairs, knots) bool.
    """
    any_known = known.sum(axis=0) >= 1
    motion = tuple(
        _fitted([solution.motion[:, axis]], [any_known], 12, 0.004, before.motion[axis]) for axis in (0, 1)
    )
    own = tuple(
        _fitted(list(solution.own[:, :, axis]), list(known), 3, 0.001, before.own[axis]) for axis in (0, 1)
    )
    return Habits((motion[0], motion[1]), (own[0], own[1]))


def _fitted(curves: list[Floats], known: list[Floats], order: int, least_px: float, before: Curve) -> Curve:
    """Least squares over all stretches known throughout, drawn a little to a straight line."""
    past, now = [], []
    for curve, good in zip(curves, known, strict=True):
        if len(curve) <= order + 1:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(curve, order + 1)
        whole = np.lib.stride_tricks.sliding_window_view(good, order + 1).all(axis=1)
        past.append(windows[whole, order - 1 :: -1] if order > 0 else windows[whole, :0])
        now.append(windows[whole, order])
    if not now or sum(map(len, now)) < 20 * order:
        return before
    a, y = np.concatenate(past), np.concatenate(now)
    straight = np.zeros(order)
    straight[:2] = STRAIGHT
    rest = y - a @ straight
    ridge = 1e-3 * len(y) * least_px**2 + 1e-9
    weights = straight + np.linalg.solve(a.T @ a + ridge * np.eye(order), a.T @ rest)
    left = y - a @ weights
    # Half of what is left counts by its middle: a few bad knots do not make the curve wild.
    sd = max(float(np.sqrt(np.mean(left**2))), least_px)
    return Curve(weights, sd)


def _bands(habits: Habits, knots: int, pairs: int) -> list[Floats]:
    """Bands of the curves' precision: bands[d] (knots - d, 2 + 2 pairs) joins knot j and j + d."""
    each = [*habits.motion, *(habits.own * pairs)]
    reach = max(len(curve.weights) for curve in each)
    out = [np.zeros((max(knots - d, 0), len(each))) for d in range(reach + 1)]
    for column, curve in enumerate(each):
        taps = np.concatenate([-curve.weights[::-1], [1.0]]) / curve.sd_px
        order = len(curve.weights)
        rows = knots - order
        if rows <= 0:
            continue
        for i in range(order + 1):
            for j in range(i, order + 1):
                out[j - i][i : i + rows, column] += taps[i] * taps[j]
    return out


def _matrix(diagonal: Floats, bands: list[Floats]) -> bsr_matrix:
    n, size = diagonal.shape[:2]
    along = np.arange(size)
    diagonal[:, along, along] += bands[0]
    reach = min(len(bands) - 1, n - 1)
    blocks, row, column = [diagonal], [np.arange(n)], [np.arange(n)]
    for d in range(1, reach + 1):
        block = np.zeros((n - d, size, size))
        block[:, along, along] = bands[d]
        lower, upper = np.arange(d, n), np.arange(n - d)
        blocks += [block, block]
        row += [upper, lower]
        column += [lower, upper]
    rows, columns = np.concatenate(row), np.concatenate(column)
    order = np.lexsort((columns, rows))
    starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])
    return bsr_matrix(
        (np.concatenate(blocks)[order], columns[order], starts), shape=(n * size, n * size), blocksize=(size, size)
    )
