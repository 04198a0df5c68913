"""Cauchy's function: what is far off loses its say without being cut off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
_CAUCHY = 3.0


def cauchy_weight(standardised: Floats) -> Floats:
    """Weights of standardised residual lengths."""
    return np.asarray(1.0 / (1.0 + (standardised / _CAUCHY) ** 2))


def cauchy_cost(standardised: Floats) -> float:
    """The sum that `cauchy_weight` minimises by re-weighted least squares; a square for small residuals."""
    return float((_CAUCHY**2 * np.log1p((standardised / _CAUCHY) ** 2)).sum())
