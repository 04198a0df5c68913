"""The motion shared by all pairs and each pair's own part, from what was measured at knots: a smoother.

Unknowns at every knot: the motion b and one own part p per pair, columns and lines each; a pair measures b +
p. Autoregressions learned from the scene itself describe what can be expected of a curve between
measurements. That of the motion, whose jitter is a few nearly pure tones, has a higher order. Those of the
own parts (drift angle, mounting, relief) have a low one. An autoregression holds forwards and backwards. The
normal equations are a band along the strip and solved by Cholesky.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.arrays import Bools, Floats
from geomosaic.ccd.banded import Banded
from geomosaic.ccd.expected import NOMINAL_SD_PX, Expected
from geomosaic.constants import tuned
from geomosaic.estimation.linear import inverse, solve

_LEAST_WINDOWS = tuned(8, "1", "stretches a weight: fewer fit noise; more leave scenes without prediction")
_FREE_KNOTS = tuned(60, "knots", "pulled to the level as one: fewer flatten slow motion; more run off")
_JERK = tuned(2.1, "usual motion", "prior of a knot's change: less smooths jitter; more follows noise")
_MOTION_ORDER = tuned(12, "knots", "autoregression, two a tone: fewer cannot bridge jitter; more learn noise")
_OWN_STRIDE = tuned(4, "knots", "between knots of own parts: nearer slopes are noise; farther lose hills")
_MOST_RADIUS = tuned(0.9995, "1", "of roots; half in 1386 knots: 1 never decays; less damps jitter in gaps")


@dataclass(frozen=True)
class Curve:
    """A linear prediction of a curve's knot from some before, `stride` knots apart.

    weights (order,), the nearest first; sd_px: deviation of what is left. With a stride the chains that
    lie between one another show nearly the same, and each counts as its share.
    """

    weights: Floats
    sd_px: float
    stride: int = 1


@dataclass(frozen=True)
class MotionPriors:
    """What is expected of the curves: motion and own parts, columns and lines each; how far motion goes."""

    motion: tuple[tuple[Curve, ...], tuple[Curve, ...]]
    own: tuple[tuple[Curve, ...], tuple[Curve, ...]]
    reach_px: float


@dataclass(frozen=True)
class Smoothed:
    """motion (knots, 2) and own (pairs, knots, 2) in px; covariance (pairs, knots, 2, 2) of their sums."""

    motion: Floats
    own: Floats
    covariance: Floats | None

    @property
    def offsets_px(self) -> Floats:
        return self.motion[None] + self.own


def prediction(order: int) -> Floats:
    """The weights by which a difference of an order is zero: 1 stays at the level, 2 goes straight on."""
    return np.asarray(-np.poly(np.ones(order))[1:], dtype=np.float64)


def first_priors(likely: Expected) -> MotionPriors:
    """What is expected before anything was seen: motion by its usual change, own parts by relief."""
    jerk = _JERK * likely.moves_px_per_line * likely.knot_lines
    relief = likely.bends_px_per_line * _OWN_STRIDE * likely.knot_lines
    motion = (Curve(prediction(2), jerk),)
    fine, warmth = (0.02, 0.03), 0.05
    own = [
        tuple(
            Curve(prediction(order), by_px, stride)
            for order, by_px, stride in (
                (2, sd, 1),
                (2, math.hypot(warmth, by), _OWN_STRIDE),
                (1, 2 * math.hypot(warmth, by), _OWN_STRIDE),
            )
        )
        for sd, by in zip(fine, (0.0, relief), strict=True)
    ]
    return MotionPriors((motion, motion), (own[0], own[1]), likely.far_px)


def smooth(
    offset_px: Floats, information: Floats, level_px: Floats, priors: MotionPriors, covariance: bool = False
) -> Smoothed:
    """The most probable curves.

    Args: offset_px (pairs, knots, 2) measured, information (pairs, knots, 2, 2) its inverse covariance;
    level_px (pairs, 2): about where each pair's curves lie, to which they return where nothing is known.
    """
    k, n = offset_px.shape[:2]
    factor, right = _equations(offset_px, information, level_px, priors)
    sums = None
    if covariance:
        whole = factor.inverse_blocks().reshape(n, k + 1, 2, k + 1, 2)
        sums = np.stack(
            [
                whole[:, 0, :, 0] + whole[:, p, :, p] + whole[:, 0, :, p] + whole[:, p, :, 0]
                for p in range(1, k + 1)
            ]
        )
    return _curves(factor.solve(right.reshape(-1, 1)), level_px, sums)


def smooth_with_shift(
    offset_px: Floats, information: Floats, part: Bools, level_px: Floats, priors: MotionPriors
) -> tuple[Smoothed, Floats, Floats]:
    """The most probable curves if a part (pairs, knots) lies off them by one vector that is not known.

    Returns: the curves, that vector (2,) and its covariance (2, 2): Schur's complement of the curves.
    """
    factor, right = _equations(offset_px, information, level_px, priors)
    n, size = right.shape
    mine = np.where(part[..., None, None], information, 0.0)
    joined = np.zeros((n, size, 2))
    joined[:, :2] = mine.sum(axis=0)
    joined[:, 2:] = np.moveaxis(mine, 0, 1).reshape(n, size - 2, 2)
    columns = joined.reshape(-1, 2)
    moved = offset_px - level_px[:, None]
    solved = factor.solve(np.concatenate([right.reshape(-1, 1), columns], axis=1))
    least = 1e-9 * np.eye(2)
    covariance = inverse(mine.sum(axis=(0, 1)) - columns.T @ solved[:, 1:] + least)
    shift = covariance @ (np.einsum("knij,knj->i", mine, moved) - columns.T @ solved[:, 0])
    return _curves(solved[:, 0] - solved[:, 1:] @ shift, level_px, None), shift, covariance


def _equations(
    offset_px: Floats, information: Floats, level_px: Floats, priors: MotionPriors
) -> tuple[Banded, Floats]:
    """Normal equations of the curves less their levels: factors, and the right side (knots, 2 + 2 pairs)."""
    k, n = offset_px.shape[:2]
    offset_px = offset_px - level_px[:, None]
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
    spread = np.array([priors.reach_px] * 2 + [NOMINAL_SD_PX] * (2 * k))
    diagonal[:, np.arange(size), np.arange(size)] += spread**-2 / _FREE_KNOTS
    own, *others = _bands(priors, n, k)
    diagonal[:, np.arange(size), np.arange(size)] += own
    return Banded(diagonal, others), right


def _curves(solved: Floats, level_px: Floats, covariance: Floats | None) -> Smoothed:
    common = np.median(level_px, axis=0)
    x = solved.reshape(-1, len(level_px) + 1, 2)
    own = np.moveaxis(x[:, 1:], 1, 0) + (level_px - common)[:, None]
    return Smoothed(x[:, 0] + common, own, covariance)


def learned(solution: Smoothed, known: Bools, before: MotionPriors) -> MotionPriors:
    """MotionPriors of the curves of a solution, from where they were well measured.

    Args: known (pairs, knots) bool.
    """
    any_known: Bools = np.asarray(known.any(axis=0))
    shared = solution.motion - solution.motion[any_known].mean(axis=0) if any_known.any() else solution.motion
    mean = np.stack([_mean(own, good) for own, good in zip(solution.own, known, strict=True)])
    own = solution.own - mean[:, None]
    motion = [
        (_fitted([shared[:, axis]], [any_known], _MOTION_ORDER, 1, 0.004) or before.motion[axis][0],)
        for axis in (0, 1)
    ]
    apart = []
    lasting = (2.0 * _OWN_STRIDE) ** 0.5  # steps of a level, as slopes last for two strides
    for axis in (0, 1):
        curves = list(own[:, :, axis])
        bending, slow, level = before.own[axis]
        apart.append(
            (
                _spread(curves, list(known), Curve(prediction(4), 0.002), bending, 1.2),
                _spread(curves, list(known), Curve(prediction(2), 0.003, _OWN_STRIDE), slow, 1.2),
                _spread(curves, list(known), Curve(prediction(1), 0.003, _OWN_STRIDE), level, lasting),
            )
        )
    return MotionPriors((motion[0], motion[1]), (apart[0], apart[1]), before.reach_px)


def _mean(curve: Floats, known: Bools) -> Floats:
    return np.asarray((curve[known] if known.any() else curve).mean(axis=0))


def _windows(curves: list[Floats], known: list[Bools], order: int, stride: int) -> tuple[Floats, Floats]:
    """Knots (m,) and the ones before them (m, order), the nearest first, where all are known."""
    past, now = [np.zeros((0, order))], [np.zeros(0)]
    for curve, good in zip(curves, known, strict=True):
        if len(curve) > order * stride:
            windows = np.lib.stride_tricks.sliding_window_view(curve, order * stride + 1)[:, ::-stride]
            whole = np.lib.stride_tricks.sliding_window_view(good, order * stride + 1)[:, ::-stride].all(
                axis=1
            )
            past.append(windows[whole, 1:])
            now.append(windows[whole, 0])
    return np.concatenate(now), np.concatenate(past)


def _fitted(
    curves: list[Floats], known: list[Bools], order: int, stride: int, least_px: float
) -> Curve | None:
    """Least squares over all stretches known throughout; None where these are too few.

    The deviation is that of new stretches (final prediction error, Akaike 1969).
    """
    y, a = _windows(curves, known, order, stride)
    if len(y) < _LEAST_WINDOWS * order:
        return None
    normal = a.T @ a + len(y) * 0.1 * least_px**2 * np.eye(order)
    weights = _stable(np.asarray(solve(normal, a.T @ y)))
    variance = float(np.mean((y - a @ weights) ** 2)) * (len(y) + order) / (len(y) - order)
    return Curve(weights, max(math.sqrt(variance), least_px), stride)


def _spread(curves: list[Floats], known: list[Bools], least: Curve, before: Curve, wider: float) -> Curve:
    """The prediction with the deviation that curves show of it, times `wider`; `before` if too little is
    known. least: the prediction and its smallest deviation."""
    y, a = _windows(curves, known, len(least.weights), least.stride)
    if len(y) < 30:
        return before
    usual = max(float(np.sqrt(np.mean((y - a @ least.weights) ** 2))), least.sd_px)
    return replace(least, sd_px=wider * usual)


def _stable(weights: Floats) -> Floats:
    """The prediction with its roots inside the unit circle: nothing grows where nothing is measured."""
    roots = np.roots(np.concatenate([[1.0], -weights]))
    size = np.abs(roots)
    if not size.size or size.max() <= _MOST_RADIUS:
        return weights
    roots = np.where(size > _MOST_RADIUS, roots * (_MOST_RADIUS / np.maximum(size, 1e-12)), roots)
    return -np.real(np.poly(roots))[1:]


def _bands(priors: MotionPriors, knots: int, pairs: int) -> list[Floats]:
    """Bands of the curves' precision: bands[d] (knots - d, 2 + 2 pairs) joins knot j and j + d."""
    each = [*priors.motion, *(priors.own * pairs)]
    reach = max(len(curve.weights) * curve.stride for curves in each for curve in curves)
    out = [np.zeros((max(knots - d, 0), len(each))) for d in range(reach + 1)]
    for column, curves in enumerate(each):
        for curve in curves:
            forth = np.concatenate([-curve.weights[::-1], [1.0]]) / (
                curve.sd_px * (2.0 * curve.stride) ** 0.5
            )
            order, step = len(curve.weights), curve.stride
            rows = max(knots - order * step, 0)
            for taps in (forth, forth[::-1]):
                for i in range(order + 1):
                    for j in range(i, order + 1):
                        out[(j - i) * step][i * step : i * step + rows, column] += taps[i] * taps[j]
    return out
