"""Robust weights: what is far off loses its say without being cut off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_CAUCHY = 3.0
LIES = 6.0
"""Deviations beyond which an observation is called wrong: of a million honest ones none is."""
_NO_SAY = 1e-6
_FREEDOM = 5.0
"""Degrees of freedom of image errors. Keypoints on what moves or looks alike leave long tails: on 14
simulated surveys in which they do, 5 to 9 gave shapes up to a third better than Cauchy's function at 3
deviations. Where errors are normal, squares are 3 % above those stated with 5, 8 % with 4
(`tests/test_bundle_covariance.py`). No survey tells its own: a point seen twice takes three of four numbers,
and whatever its errors are, its residuals look long-tailed."""
TELLS = (_FREEDOM + 2.0) / (_FREEDOM + 4.0)
"""What a pair that errs by Student's distribution tells, as a share of a normal one of the same scale (Lange,
Little and Taylor 1989, Journal of the American Statistical Association 84, appendix B)."""


def cauchy_weight(standardised: Floats) -> Floats:
    """Weights of standardised residual lengths."""
    return np.asarray(1.0 / (1.0 + (standardised / _CAUCHY) ** 2))


def cauchy_cost(standardised: Floats) -> float:
    """The sum that `cauchy_weight` minimises by re-weighted least squares; a square for small residuals."""
    return float((_CAUCHY**2 * np.log1p((standardised / _CAUCHY) ** 2)).sum())


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
    the deviation of normal pairs that would tell as much (ibid., section 3)."""
    return np.asarray((_FREEDOM + 2.0) / (_FREEDOM + standardised**2 / TELLS))


def student_cost(standardised: Floats) -> Floats:
    """Twice the negative logarithm of the density, 0 at 0; its slope by the square: the weight over TELLS."""
    return np.asarray((_FREEDOM + 2.0) * np.log1p(standardised**2 / (TELLS * _FREEDOM)))
