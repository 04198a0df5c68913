"""Figures of control and check points: how far surveyed points lie from where the images put them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ControlFigures:
    """Of n points. rmse_horizontal_m is of the length in the plane. ce90_m and le90_m: nine tenths of the
    points are nearer in the plane and in height, the quantiles of what was found (linear between two
    points; no normal distribution assumed), so with few points little less than the largest.
    """

    n: int
    rmse_east_m: float
    rmse_north_m: float
    rmse_up_m: float
    rmse_horizontal_m: float
    ce90_m: float
    le90_m: float


def control_figures(residuals_m: Floats) -> ControlFigures:
    """Figures of residuals (n, 3), east, north and up; n >= 1."""
    east, north, up = np.sqrt(np.mean(np.square(residuals_m), axis=0)).tolist()
    return ControlFigures(
        n=len(residuals_m),
        rmse_east_m=east,
        rmse_north_m=north,
        rmse_up_m=up,
        rmse_horizontal_m=float(np.hypot(east, north)),
        ce90_m=float(np.quantile(np.hypot(residuals_m[:, 0], residuals_m[:, 1]), 0.9)),
        le90_m=float(np.quantile(np.abs(residuals_m[:, 2]), 0.9)),
    )
