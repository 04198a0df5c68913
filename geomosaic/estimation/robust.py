"""Robust weights and costs, iteratively re-weighted least squares, and tests for blunders."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import erfc, stdtrit

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import NORMAL_PER_MAD, SLIGHT, sourced, tuned
from geomosaic.estimation.linear import least_squares

_FREEDOM = sourced(5.0, "degrees of freedom", "of image errors with long tails", "docs/results.md")
INFORMATION: float = sourced((_FREEDOM + 2) / (_FREEDOM + 4), "1", "of Student pairs", "Lange 1989, app. B")
THREE_SIGMA = sourced(3.0, "deviations", "beyond: not chance; half weight", "normal errors: 0.3 %")
BLUNDER = 2.0 * THREE_SIGMA
"""Residuals of blunders: beyond it nothing keeps its weight."""
STRONG = sourced(20.0, "evidence ratio", "that counts as strong", "Kass and Raftery 1995, section 3.2")
LEAST_OBSERVATIONS = sourced(5, "observations", "to call one a blunder", "the median holds with 2 of 5 wrong")
LEAST_REDUNDANCY = tuned(3.0, "redundant observations", "fewer: a variance component is chance")
LEAST_NOISE = tuned(0.2, "of the stated deviations", "less: a few that agree by chance outvote the rest")
_OWN = tuned(2.0, "stated deviations", "least size; less: chance agreement of others names good points")
FAR = tuned(5.0, "deviations", "blunders by stated deviation and scatter; fewer: good points are named")


def irls(
    design: Floats,
    observed: Floats,
    weigh: Callable[[Floats], Floats],
    start: Floats | None = None,
    rounds: int = 10,
) -> tuple[Floats, Floats]:
    """Unknowns (u,) and last weights by iteratively re-weighted least squares, of the smallest norm, after so
    many rounds or when weights repeat. Args: design (m, u), or (m, c, u) for observations of c components;
    observed (m,) or (m, c); weigh: from residuals, shaped as observed, to weights that broadcast with them;
    start (u,): without it the first residuals are those of the median."""
    unknowns = np.zeros(design.shape[-1]) if start is None else start
    residual = observed - (np.median(observed, axis=0) if start is None else design @ start)
    rows, weight = design.reshape(-1, design.shape[-1]), np.zeros(0)
    for _ in range(rounds):
        before, weight = weight, weigh(residual)
        if np.array_equal(weight, before):
            break
        weighted = (design * weight[..., None]).reshape(rows.shape)
        normal = weighted.T @ rows
        size = np.sqrt(np.diag(normal)) + 1e-12
        scaled = normal / (size[:, None] * size)
        unknowns = least_squares(scaled, weighted.T @ observed.ravel() / size, rcond=1e-12) / size
        residual = observed - design @ unknowns
    return unknowns, weight


def cauchy_weight(standardised: Floats) -> Floats:
    """Cauchy's weights of standardised residual lengths."""
    return np.asarray(1.0 / (1.0 + (standardised / THREE_SIGMA) ** 2))


def cauchy_cost(standardised: Floats) -> Floats:
    """The cost that `cauchy_weight` minimises; the square for small residuals."""
    return np.asarray(THREE_SIGMA**2 * np.log1p((standardised / THREE_SIGMA) ** 2))


def redescending_weight(standardised: Floats) -> Floats:
    """Weights for GNSS and IMU data, nearly all of which are right: 1 up to three deviations, then falling
    with the square, next to 0 beyond six. Cauchy's would take a quarter of the weight of three good
    numbers."""
    falling = (THREE_SIGMA / np.maximum(standardised, THREE_SIGMA)) ** 2
    return np.asarray(np.where(standardised > BLUNDER, SLIGHT, falling))


def student_weight(standardised: Floats) -> Floats:
    """Weights of pairs with Student's distribution, 1 in the mean, by their standardised lengths. The
    deviation is that of normal pairs with the same information (Lange et al. 1989, section 3)."""
    return np.asarray((_FREEDOM + 2.0) / (_FREEDOM + standardised**2 / INFORMATION))


def student_cost(standardised: Floats) -> Floats:
    """Twice the negative log density, 0 at 0; its derivative by the square is weight / INFORMATION."""
    return np.asarray((_FREEDOM + 2.0) * np.log1p(standardised**2 / (INFORMATION * _FREEDOM)))


def student_bend(standardised: Floats) -> Floats:
    """By how much the curvature of `student_cost` along an error is below that across it, as a share."""
    square = standardised**2
    return np.asarray(2.0 * square / (INFORMATION * _FREEDOM + square))


def share_down_weighted(standardised: Floats) -> float:
    """The share of pairs with less than half the `student_weight` of a residual of 0; NaN without pairs."""
    half = student_weight(standardised) < student_weight(np.zeros(1)) / 2.0
    return float(half.mean()) if half.size else float("nan")


def credible(factor: float, redundancy: float) -> float:
    """A factor of standard deviations, shrunk towards 1 where it may be chance. Its logarithm is weighted
    with the probability that the stated deviation is wrong, by Schwarz's approximation (1978) of the
    evidence. With a redundancy of 48, 1.1 is chance and 1.5 is not."""
    variance = max(factor**2, 1e-6)
    evidence = redundancy / 2.0 * (variance - 1.0 - np.log(variance))
    wrong = 1.0 / (1.0 + np.sqrt(redundancy) * np.exp(-min(evidence, 500.0)))
    return float(np.exp(wrong * np.log(variance) / 2.0))


def median_of_known(values: Floats) -> float:
    """Median of the finite values, 0 where there is none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else 0.0


def blunders(values: Floats, sd: Floats) -> Bools:
    """Which of n observations (n,) are blunders; none among fewer than five.

    A blunder differs from the median by more than two of its deviations (n,), and by more than the scatter of
    the others explains. (Rosner 1983: generalised extreme studentised deviates.) An observation that differs
    by more than five deviations, stated and by the MAD, is one too. The deviations may include an error that
    all share. Args: values, sd: in one unit, finite, sd > 0.
    """
    n = len(values)
    if n < LEAST_OBSERVATIONS:
        return np.zeros(n, dtype=bool)
    off = np.abs(values - np.median(values))
    mad = NORMAL_PER_MAD * float(np.median(off / sd))
    found = np.asarray(off > FAR * max(mad, 1.0) * sd)
    order = np.argsort(-off / sd, kind="stable")
    for k in range((n - 3) // 2, 0, -1):
        tested, rest = order[k - 1], order[k:]
        if off[tested] > _OWN * sd[tested] and _studentised(values, sd, tested, rest) > _quantile(len(rest)):
            found[order[:k]] = True
            break
    return found


def _studentised(values: Floats, sd: Floats, tested: np.intp, rest: Ints) -> float:
    """Distance of an observation from the weighted mean of the rest, over the deviation of that distance."""
    weight = 1.0 / sd[rest] ** 2
    mean = float(weight @ values[rest] / weight.sum())
    factor = float(np.sqrt(weight @ (values[rest] - mean) ** 2 / (len(rest) - 1)))
    spread = factor * float(np.sqrt(sd[tested] ** 2 + 1.0 / weight.sum()))
    return abs(float(values[tested]) - mean) / max(spread, np.finfo(np.float64).tiny)


def _quantile(rest: int) -> float:
    """Student's quantile for the most extreme of rest + 1 observations, as rare as three deviations are."""
    return float(stdtrit(rest - 1, 1.0 - erfc(THREE_SIGMA / np.sqrt(2.0)) / (2.0 * (rest + 1))))
