"""Poses of frames without tie points, predicted from the corrections of the tied frames around them. The
prediction is least-squares collocation (Moritz 1980, Advanced Physical Geodesy), since errors of GNSS and IMU
are correlated along a flight."""

from __future__ import annotations

from contextlib import suppress
from copy import deepcopy

import numpy as np

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import exp_turn, log_turn
from geomosaic.constants import MEDIAN_LENGTH, MEDIAN_ONE, TOGETHER, tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.linear import cholesky, solve
from geomosaic.estimation.robust import LEAST_NOISE, LEAST_REDUNDANCY, irls, redescending_weight
from geomosaic.placement.prior import heading_assumed, position_assumed

_LENGTHS = tuned((2.0, 5.0, 15.0, 50.0), "distances of neighbours", "of correlation, up to a whole flight")
_SHARES = tuned((0.3, 0.7, 0.95), "of the variance", "correlated, compared by likelihood")


def moved_with_neighbours(given: Poses, found: Poses, tied: Bools, untied: Bools) -> Poses:
    """The poses `found` with the untied frames' predicted from those given: shift, turn and scale in plan,
    height, attitude, with the deviations of the prediction. Assumed positions and headings stay. Args: tied,
    untied (n,): which frames."""
    located = ~position_assumed(given)
    known, wanted = np.flatnonzero(tied & located), np.flatnonzero(untied & located)
    if not len(known):
        return found
    out, at = deepcopy(found), given.positions_m[:, :2]
    for i in wanted:
        away_m = np.linalg.norm(at[known] - at[i], axis=1)
        with suppress(NotSolvableError):
            _move(out, given, int(i), known[np.argsort(away_m, kind="stable")[:TOGETHER]])
    return out


def _move(out: Poses, given: Poses, i: int, near: Ints) -> None:
    """Moves frame i like those near it, in place; plan, height and each angle by itself."""
    at = given.positions_m[near, :2] - given.positions_m[i, :2]
    turned = log_turn(np.swapaxes(given.rotations, 1, 2)[near] @ out.rotations[near])
    corrections = np.hstack([out.positions_m[near] - given.positions_m[near], turned])
    stated, own = (np.hstack([p.positions_sd_m, p.rotations_sd_rad]) for p in (given, out))
    value, sd, own_sd = np.zeros(6), stated[i].copy(), np.median(own[near], axis=0)
    observed = np.ones((len(given), 6), dtype=bool)
    observed[:, 5] = ~heading_assumed(given)
    for axes in (slice(0, 2), slice(2, 3), slice(3, 4), slice(4, 5), slice(5, 6)):
        mine = observed[near, axes].all(axis=1)
        if mine.any() and observed[i, axes].all():
            of_each = np.sqrt((stated[np.append(near[mine], i), axes] ** 2).mean(axis=1))
            value[axes], predicted_sd = _predicted(at[mine], corrections[mine, axes], of_each)
            sd[axes] = np.hypot(predicted_sd, own_sd[axes])
    out.positions_m[i] = given.positions_m[i] + value[:3]
    out.positions_sd_m[i], out.rotations_sd_rad[i] = sd[:3], sd[3:]
    out.rotations[i] = given.rotations[i] @ exp_turn(value[None, 3:])[0]


def _predicted(at_m: Floats, values: Floats, stated: Floats) -> tuple[Floats, float]:
    """The correction (c,) at the origin and its deviation per component, from corrections (k, c) elsewhere.

    The model is a trend (a constant, or in plan a similarity), a signal of exponential covariance, and noise
    in proportion to the stated deviations. The restricted likelihood decides on length and share of the
    signal, and by Schwarz's criterion (1978) on the signal itself. Args: at_m (k, 2); stated (k + 1,):
    deviations of the corrections and, last, of the prediction.
    """
    k, c = values.shape
    apart_m, away_m = np.linalg.norm(at_m[:, None] - at_m, axis=2), np.linalg.norm(at_m, axis=1)
    spacing_m = float(np.median((apart_m + np.diag(np.full(k, np.inf))).min(axis=1))) if k > 1 else 0.0
    spacing_m = spacing_m or max(float(away_m.min()), 1.0)
    many, base = k > 2.0 + LEAST_REDUNDANCY, np.column_stack([np.ones(k), at_m / spacing_m])
    trend = _trend(c, similarity=many and c == 2 and np.ptp(at_m, axis=0).max() > spacing_m)
    noise, scale = _noise(base, trend, values, stated[:-1]), float(np.mean(stated[:-1] ** 2))
    signals = [(share, length) for share in _SHARES for length in _LENGTHS] if many else []
    tried = []
    for share, length in ((0.0, 1.0), *signals):
        signal, here = (share * scale * np.exp(-d / (length * spacing_m)) for d in (apart_m, away_m))
        alone = share * scale + (1.0 - share) * float(stated[-1] ** 2)
        covariance = signal + np.diag((1.0 - share) * noise)
        likelihood, value, factor, beyond = _collocated(covariance, here, base, trend, values)
        likelihood -= np.log(values.size) if share else 0.0
        tried.append((likelihood, value, float(np.sqrt(factor * max(alone + beyond, 0.0)))))
    return max(tried, key=lambda t: t[0])[1:]


def _trend(components: int, similarity: bool) -> Floats:
    """Factors (c, 3, p) of 1, east and north: a shift of each component; in plan scale and turn too."""
    out = np.zeros((components, 3, components + 2 * similarity))
    out[:, 0, :components] = np.eye(components)
    if similarity:
        out[0, 1, 2] = out[1, 2, 2] = out[1, 1, 3] = 1.0
        out[0, 2, 3] = -1.0
    return out


def _noise(base: Floats, trend: Floats, values: Floats, stated: Floats) -> Floats:
    """Variances (k,) of the corrections: the stated ones, larger for corrections far off the trend."""
    k, c = values.shape

    def weigh(left: Floats) -> Floats:
        length = np.linalg.norm(left, axis=1) / stated
        noise = max(float(np.median(length)) / (MEDIAN_LENGTH if c == 2 else MEDIAN_ONE), LEAST_NOISE)
        return np.asarray((redescending_weight(length / noise) / stated**2)[:, None])

    if k <= 2:
        return stated**2
    return np.asarray(1.0 / irls(np.einsum("kb,cbp->kcp", base, trend), values, weigh)[1][:, 0])


def _collocated(
    covariance: Floats, here: Floats, base: Floats, trend: Floats, values: Floats
) -> tuple[float, Floats, float, float]:
    """Restricted log-likelihood, prediction (c,), the factor of all variances, and the prediction's variance
    without that factor beyond that of a frame by itself."""
    c, redundancy = values.shape[1], values.size - trend.shape[2]
    solved = solve(covariance, np.column_stack([base, values, here]))
    of_base, of_values, of_here = np.split(solved, [3, 3 + c], axis=1)
    inner = np.einsum("cbp,bd,cdq->pq", trend, base.T @ of_base, trend)
    by_component = trend @ solve(inner, np.einsum("cbp,bc->p", trend, base.T @ of_values))
    left = values - base @ by_component.T
    squares = float((left * (of_values - of_base @ by_component.T)).sum())
    counts = c * LEAST_REDUNDANCY
    factor = (squares + counts) / (redundancy + counts)
    determinant = c * 2.0 * np.log(np.diag(cholesky(covariance)[0])).sum() + np.linalg.slogdet(inner)[1]
    unknown = trend[0].T @ (np.array([1.0, 0.0, 0.0]) - of_here[:, 0] @ base)
    beyond = float(unknown @ solve(inner, unknown) - here @ of_here[:, 0])
    likelihood = -0.5 * ((redundancy + counts) * float(np.log(factor)) + float(determinant))
    return likelihood, by_component[:, 0] + of_here[:, 0] @ left, factor, beyond
