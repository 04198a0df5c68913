"""Robust weights: what is far off loses its say without being cut off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import sourced, tuned

Floats = NDArray[np.float64]
_CAUCHY = tuned(
    3.0,
    "deviations",
    "where Cauchy's weight is a half, and where a tag's begins to fall: with less, what is merely noisy "
    "loses its say; with more, what is wrong keeps it",
)
LIES = tuned(
    6.0,
    "deviations",
    "beyond which an observation is called wrong: of a million honest ones none is; with less, honest "
    "ones would be named",
)
_NO_SAY = tuned(
    1e-6,
    "share of the full weight",
    "left to what is called wrong: it doesn't pull, but a frame that nothing else holds keeps its "
    "place; with 0 the equations could not be solved",
)
_FREEDOM = sourced(
    5.0,
    "degrees of freedom",
    "of image errors: keypoints on what moves or looks alike leave long tails, for which 5 to 9 gave "
    "shapes up to a third better than Cauchy's function at 3 deviations. Where errors are normal, "
    "squares are 3 % above those stated with 5, 8 % with 4. No survey shows its own: a point seen twice "
    "takes three of four numbers, and whatever its errors are, its residuals look long-tailed",
    "docs/results.md, Student's distribution of image errors: 14 dirty surveys, seeds 102 to 329; "
    "normal errors: tests/test_bundle_covariance.py, seeds 1 to 6",
)
INFORMATION: float = sourced(
    (_FREEDOM + 2.0) / (_FREEDOM + 4.0),
    "share of a normal pair's information",
    "what a pair that errs by Student's distribution contributes beside a normal one of the same scale: "
    "weights without it state deviations that are too small",
    "Lange, Little and Taylor 1989, Journal of the American Statistical Association 84, appendix B",
)


def cauchy_weight(standardised: Floats) -> Floats:
    """Weights of standardised residual lengths."""
    return np.asarray(1.0 / (1.0 + (standardised / _CAUCHY) ** 2))


def cauchy_cost(standardised: Floats) -> Floats:
    """Of what `cauchy_weight` minimises the sum by re-weighted least squares; squares for small residuals."""
    return np.asarray(_CAUCHY**2 * np.log1p((standardised / _CAUCHY) ** 2))


def lie_weight(standardised: Floats) -> Floats:
    """1 up to three deviations, beyond them falling with the square of the distance; next to none beyond
    six, where a tag is called wrong: it no longer pulls.

    For tags of which nearly all are right: Cauchy's function takes a quarter of their weight from position
    tags (three numbers each) that are merely noisy, which costs accuracy and overstates deviations.
    """
    falling = (_CAUCHY / np.maximum(standardised, _CAUCHY)) ** 2
    return np.asarray(np.where(standardised > LIES, _NO_SAY, falling))


def student_weight(standardised: Floats) -> Floats:
    """Weights of lengths of pairs that err by Student's distribution, 1 in the mean; they are standardised by
    the deviation of normal pairs that would contribute as much (Lange, Little and Taylor 1989, section 3)."""
    return np.asarray((_FREEDOM + 2.0) / (_FREEDOM + standardised**2 / INFORMATION))


def student_cost(standardised: Floats) -> Floats:
    """Twice the negative logarithm of the density, 0 at 0; its slope by the square: weight / INFORMATION."""
    return np.asarray((_FREEDOM + 2.0) * np.log1p(standardised**2 / (INFORMATION * _FREEDOM)))


def student_bend(standardised: Floats) -> Floats:
    """The share by which the curvature of `student_cost` along an error is less than across it, where it is
    what the weight says; beyond 1 it is negative."""
    square = standardised**2
    return np.asarray(2.0 * square / (INFORMATION * _FREEDOM + square))


def share_down_weighted(standardised: Floats) -> float:
    """The share of pairs whose `student_weight` is less than half of a perfect one's; NaN of none."""
    half = student_weight(standardised) < student_weight(np.zeros(1)) / 2.0
    return float(half.mean()) if half.size else float("nan")


def credible(factor: float, redundancy: float) -> float:
    """A factor estimated from so many redundant observations, drawn to 1 where it may as well be chance.

    Its logarithm is weighed with the probability that the stated deviation is wrong, by Schwarz's
    approximation (1978) of the evidence: of 48 observations a factor of 1.1 is chance, one of 1.5 is not.
    Else the covariance of a small block with rightly stated deviations would follow their draw.
    """
    variance = max(factor**2, 1e-6)
    evidence = redundancy / 2.0 * (variance - 1.0 - np.log(variance))
    wrong = 1.0 / (1.0 + np.sqrt(redundancy) * np.exp(-min(evidence, 500.0)))
    return float(np.exp(wrong * np.log(variance) / 2.0))


def median_of_known(values: Floats) -> float:
    """Median of the finite values, 0 where there is none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else 0.0
