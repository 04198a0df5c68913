"""Cauchy's function: what is far off loses its say without being cut off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_CAUCHY = 3.0
LIES = 6.0
"""Deviations beyond which an observation is called wrong: of a million honest ones none is."""
_NO_SAY = 1e-6


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
