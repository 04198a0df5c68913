"""Frames without tie points take the correction that the tied frames around them found.

Positions and attitudes of a flight err alike from frame to frame: a receiver's bias, a datum, a compass, a
drifting height. The tied frames show these errors; least-squares collocation (Moritz 1980, Advanced Physical
Geodesy) predicts them for the others.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import exp_turn, log_turn
from geomosaic.constants import MEDIAN_LENGTH, MEDIAN_ONE, sourced, tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.linear import cholesky, least_squares, solve
from geomosaic.estimation.robust import lie_weight
from geomosaic.placement.prior import heading_assumed, position_assumed

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]
_NEAREST = tuned(100, "frames", "about an untied one that are asked; the cube of it is the time that takes")
_LENGTHS: tuple[float, ...] = tuned(
    (2.0, 5.0, 15.0, 50.0),
    "distances between neighbours",
    "of correlation that are compared by their likelihood: from next neighbours to a whole flight",
)
_SHARES: tuple[float, ...] = tuned(
    (0.3, 0.7, 0.95),
    "of the variance",
    "that may be correlated, compared by their likelihood",
)
_STATED_COUNTS = tuned(
    3.0,
    "redundant frames",
    "that the stated deviation counts for beside the scatter of the corrections: of two or three tied "
    "frames the scatter is chance",
)
_SIMILARITY: Floats = sourced(
    np.array(
        [
            [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, -1.0]],
            [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]],
        ]
    ),
    "factors of 1, east and north in the corrections' components, (2, 3, 4)",
    "shift east and north, scale, and turn",
    "definition",
)
_LEAST_SHARE = tuned(
    0.1,
    "share of the stated deviation",
    "that corrections scatter at least when blunders are sought",
)


def moved_with_neighbours(given: Poses, found: Poses, tied: Bools, untied: Bools) -> Poses:
    """The poses `found`, the untied ones' replaced by those given, corrected as the tied frames around them
    were: shift, turn and scale in plan, height, attitude.

    Their deviations are those of the prediction: the scatter of the tied frames' corrections, its growth with
    the distance, and the tied frames' own deviations. Positions and headings that nobody observed show
    nothing and stay.

    Args: tied, untied (n,): which frames.
    """
    located = ~position_assumed(given)
    known, asked = np.flatnonzero(tied & located), np.flatnonzero(untied & located)
    if not len(known):
        return found
    out = replace(
        found,
        positions_m=found.positions_m.copy(),
        rotations=found.rotations.copy(),
        positions_sd_m=found.positions_sd_m.copy(),
        rotations_sd_rad=found.rotations_sd_rad.copy(),
    )
    at = given.positions_m[:, :2]
    for i in asked:
        away_m = np.linalg.norm(at[known] - at[i], axis=1)
        with suppress(NotSolvableError):
            _move(out, given, int(i), known[np.argsort(away_m, kind="stable")[:_NEAREST]])
    return out


def _move(out: Poses, given: Poses, i: int, near: Ints) -> None:
    """Moves frame i as those near it were, in place."""
    at = given.positions_m[near, :2] - given.positions_m[i, :2]
    shift = out.positions_m[near] - given.positions_m[near]
    sd, own = given.positions_sd_m, np.median(out.positions_sd_m[near], axis=0)
    plan, plan_sd = _predicted(at, shift[:, :2], _stated(sd[:, :2], near, i))
    up, up_sd = _predicted(at, shift[:, 2:], _stated(sd[:, 2:], near, i))
    out.positions_m[i] = given.positions_m[i] + [*plan, *up]
    out.positions_sd_m[i] = np.hypot([plan_sd, plan_sd, up_sd], own)
    turned = log_turn(np.swapaxes(given.rotations, 1, 2)[near] @ out.rotations[near])
    sd, own = given.rotations_sd_rad, np.median(out.rotations_sd_rad[near], axis=0)
    turn, observed = np.zeros(3), ~heading_assumed(given)
    out.rotations_sd_rad[i] = sd[i]
    for axis in range(3):
        mine = observed[near] if axis == 2 else np.ones(len(near), dtype=bool)
        if not mine.any() or (axis == 2 and not observed[i]):
            continue
        stated = _stated(sd[:, axis : axis + 1], near[mine], i)
        value, value_sd = _predicted(at[mine], turned[mine, axis : axis + 1], stated)
        turn[axis], out.rotations_sd_rad[i, axis] = value[0], np.hypot(value_sd, own[axis])
    out.rotations[i] = given.rotations[i] @ exp_turn(turn[None])[0]


def _stated(sd: Floats, near: Ints, i: int) -> Floats:
    """Deviations (k + 1,) of the frames near and, last, of frame i: the mean over some columns."""
    return np.asarray(np.sqrt((sd[np.append(near, i)] ** 2).mean(axis=1)))


def _predicted(at_m: Floats, values: Floats, stated: Floats) -> tuple[Floats, float]:
    """The correction (c,) at the origin and its deviation per component, from corrections (k, c) elsewhere.

    A trend (a constant; of two components, east and north, a similarity), a signal of exponential covariance,
    and noise in proportion to what is stated. Length and share of the signal are those of the greatest
    restricted likelihood, if a signal is worth its two numbers (Schwarz 1978); wild corrections lose their
    weight first.

    Args: at_m (k, 2); stated (k + 1,): deviations of the corrections and, last, of what is asked for.
    """
    k, c = values.shape
    apart_m = np.linalg.norm(at_m[:, None] - at_m, axis=2)
    spacing_m = float(np.median((apart_m + np.diag(np.full(k, np.inf))).min(axis=1))) if k > 1 else 0.0
    spacing_m = spacing_m or max(float(np.linalg.norm(at_m, axis=1).min()), 1.0)
    many, base = k > 2.0 + _STATED_COUNTS, np.column_stack([np.ones(k), at_m / spacing_m])
    trend = _SIMILARITY[:c] if many and c == 2 and np.ptp(at_m, axis=0).max() > spacing_m else _shift(c)
    noise, scale = _noise(base, trend, values, stated[:-1]), float(np.mean(stated[:-1] ** 2))
    best: tuple[float, Floats, float] | None = None
    for share in (0.0, *_SHARES) if many else (0.0,):
        for length in _LENGTHS if share else (1.0,):
            signal = share * scale * np.exp(-apart_m / (length * spacing_m))
            here = share * scale * np.exp(-np.linalg.norm(at_m, axis=1) / (length * spacing_m))
            alone = share * scale + (1.0 - share) * float(stated[-1] ** 2)
            covariance = signal + np.diag((1.0 - share) * noise)
            tried = _collocated(covariance, here, base, trend, values)
            likelihood = tried[0] - (np.log(values.size) if share else 0.0)
            found = (likelihood, tried[1], float(np.sqrt(tried[2] * max(alone + tried[3], 0.0))))
            best = found if best is None or found[0] > best[0] else best
    assert best is not None
    return best[1], best[2]


def _shift(components: int) -> Floats:
    """A constant for each component, as _SIMILARITY is."""
    out = np.zeros((components, 3, components))
    out[:, 0] = np.eye(components)
    return out


def _noise(base: Floats, trend: Floats, values: Floats, stated: Floats) -> Floats:
    """Variances (k,) of the corrections as stated; larger ones for those that lie far off the trend."""
    k, c = values.shape
    typical = MEDIAN_LENGTH if c == 2 else MEDIAN_ONE
    design = np.einsum("kb,cbp->kcp", base, trend)
    weight, left = np.ones(k), values - np.median(values, axis=0)
    for _ in range(10 if k > 2 else 0):
        length = np.linalg.norm(left, axis=1) / stated
        weight = lie_weight(length / max(float(np.median(length)) / typical, _LEAST_SHARE))
        root = (np.sqrt(weight) / stated)[:, None]
        rows, sides = design * root[:, :, None], values * root
        left = values - design @ least_squares(rows.reshape(k * c, -1), sides.ravel())
    return stated**2 / weight


def _collocated(
    covariance: Floats, here: Floats, base: Floats, trend: Floats, values: Floats
) -> tuple[float, Floats, float, float]:
    """Restricted log-likelihood, prediction (c,), the factor of all variances, and the prediction's variance
    without that factor beyond that of a frame by itself."""
    c, redundancy = values.shape[1], values.size - trend.shape[2]
    solved = solve(covariance, np.column_stack([base, values, here]))
    of_base, of_values, of_here = np.split(solved, [3, 3 + c], axis=1)
    inner = np.einsum("cbp,bd,cdq->pq", trend, base.T @ of_base, trend)
    found = solve(inner, np.einsum("cbp,bc->p", trend, base.T @ of_values))
    by_component = trend @ found
    left = values - base @ by_component.T
    squares = float((left * (of_values - of_base @ by_component.T)).sum())
    counts = c * _STATED_COUNTS
    factor = (squares + counts) / (redundancy + counts)
    determinant = c * 2.0 * np.log(np.diag(cholesky(covariance)[0])).sum() + np.linalg.slogdet(inner)[1]
    rest = np.array([1.0, 0.0, 0.0]) - of_here[:, 0] @ base
    prediction = by_component[:, 0] + of_here[:, 0] @ left
    unknown = trend[0].T @ rest
    beyond = float(unknown @ solve(inner, unknown) - here @ of_here[:, 0])
    likelihood = -0.5 * ((redundancy + counts) * float(np.log(factor)) + float(determinant))
    return likelihood, prediction, factor, beyond
