"""What residuals of several frames or points have in common: a similarity, a plane, a mean."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import MEDIAN_LENGTH, MEDIAN_ONE, sourced
from geomosaic.estimation.linear import least_squares
from geomosaic.estimation.robust import lie_weight

_STRONG = sourced(20.0, "times likelier", "strong evidence of a slope", "Kass and Raftery 1995, section 3.2")


class RobustFit(NamedTuple):
    """Fitted values (k, n), parameters (q,), and the weights (k, n) of the last round: roots over sd."""

    fitted: Floats
    parameters: Floats
    weight: Floats


def robust_fit(
    design: Floats, residuals: Floats, sd: Floats, rounds: int = 10, rcond: float = 1e-10
) -> RobustFit:
    """Least squares re-weighted from the median residual on; residuals count by `lie_weight` of their lengths
    over the median one. Args: design (k, n, q), residuals and sd (k, n)."""
    k, n, q = design.shape
    typical = MEDIAN_LENGTH if n == 2 else MEDIAN_ONE
    fitted, found = np.zeros((k, n)) + np.median(residuals, axis=0), np.zeros(q)
    weight = 1.0 / sd
    for _ in range(rounds):
        length = np.linalg.norm((residuals - fitted) / sd, axis=1)
        bulk = max(float(np.median(length)) / typical, 1e-9)
        weight = np.sqrt(lie_weight(length / bulk))[:, None] / sd
        rows = (design * weight[:, :, None]).reshape(n * k, q)
        scale = np.linalg.norm(rows, axis=0) + 1e-12
        found = least_squares(rows / scale, (residuals * weight).ravel(), rcond=rcond) / scale
        fitted = design @ found
    return RobustFit(fitted, found, weight)


def common_similarity(at_m: Floats, miss_m: Floats, sd_m: Floats) -> Floats:
    """The part of residuals in plan (k, 2) that a similarity of all positions explains; all of them for two
    frames or fewer."""
    k = len(at_m)
    if k < 3 or not np.isfinite(sd_m).all():
        return np.where(np.isfinite(sd_m), miss_m, 0.0)
    e, n = (at_m - np.median(at_m, axis=0)).T
    zero, one = np.zeros(k), np.ones(k)
    design = np.stack([np.stack([one, zero, -n, e], 1), np.stack([zero, one, e, n], 1)], 1)
    return robust_fit(design, miss_m, sd_m).fitted


def common_slope(at_m: Floats, miss_m: Floats, sd_m: Floats, may_rad: float) -> Floats:
    """The part of residuals in height (k,) that a plane explains.

    The common height alone where the slope may be chance (Schwarz 1978) or is steeper than may_rad: then
    heights drift or jump, and the block has not tipped over.
    """
    level = np.full(len(at_m), common_mean(miss_m, sd_m))
    if len(at_m) < 4 or not np.isfinite(sd_m).all():
        return level
    design = np.column_stack([np.ones(len(at_m)), at_m - np.median(at_m, axis=0)])
    fit = robust_fit(design[:, None], miss_m[:, None], sd_m[:, None], rcond=1e-3)
    plane, weight = fit.fitted[:, 0], fit.weight[:, 0]
    squares = [float((((miss_m - its) * weight) ** 2).sum()) for its in (level, plane)]
    evidence = 0.5 * len(at_m) * np.log(max(squares[0], 1e-300) / max(squares[1], 1e-300)) - np.log(len(at_m))
    steep = np.arctan(np.hypot(*fit.parameters[1:])) > may_rad
    return np.asarray(level if steep or evidence <= np.log(_STRONG) else plane)


def common_mean(miss: Floats, sd: Floats) -> float:
    """The robust mean of residuals (k,), 0 where none has a finite deviation."""
    known = np.isfinite(sd)
    if not known.any():
        return 0.0
    one = np.ones((int(known.sum()), 1, 1))
    return float(robust_fit(one, miss[known, None], sd[known, None], rounds=5).parameters[0])
