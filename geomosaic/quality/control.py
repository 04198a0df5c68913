"""Figures of control and check points: how far surveyed points lie from where the images put them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import ControlResidual
from geomosaic.survey.accuracy import POSITION

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ControlFigures:
    """Of n points. rmse_horizontal_m is of the length in the plane. ce90_m and le90_m: nine tenths of the
    points are nearer in the plane and in height, the quantiles of what was found (linear between two
    points; no normal distribution assumed), so with few points little less than the largest. Of heights: the
    n_height points whose height was surveyed, None of none.
    """

    n: int
    n_height: int
    rmse_east_m: float
    rmse_north_m: float
    rmse_up_m: float | None
    rmse_horizontal_m: float
    ce90_m: float
    le90_m: float | None


def control_figures(residuals: Sequence[ControlResidual]) -> ControlFigures:
    """Figures of one point or more."""
    residual_m = np.stack([r.residual_m for r in residuals])
    surveyed = np.array([r.sd_m[2] < POSITION["none"].sd_vertical_m for r in residuals])
    east, north = np.sqrt(np.mean(np.square(residual_m[:, :2]), axis=0)).tolist()
    up_m = residual_m[surveyed, 2]
    return ControlFigures(
        n=len(residual_m),
        n_height=len(up_m),
        rmse_east_m=east,
        rmse_north_m=north,
        rmse_up_m=float(np.sqrt(np.mean(up_m**2))) if up_m.size else None,
        rmse_horizontal_m=float(np.hypot(east, north)),
        ce90_m=float(np.quantile(np.hypot(residual_m[:, 0], residual_m[:, 1]), 0.9)),
        le90_m=float(np.quantile(np.abs(up_m), 0.9)) if up_m.size else None,
    )
