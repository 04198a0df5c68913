"""Absolute accuracy as check points measure it: the map's shift and the scatter about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.adjustment.model import ControlResidual
from geomosaic.arrays import Floats
from geomosaic.quality.control import control_blunders, known_residuals_m, means


@dataclass(frozen=True)
class CheckPoints:
    """Figures of `count` check points, those named as blunders left out.

    mean_shift_m (3,): mean of surveyed minus found, east, north and up; scatter_m (3,): root mean square
    about that mean; rmse_m (3,): root mean square, so that rmse² = mean_shift² + scatter². Of heights: points
    whose height was surveyed, NaN without any.
    """

    count: int
    mean_shift_m: Floats
    scatter_m: Floats
    rmse_m: Floats
    blunders: tuple[str, ...]


def check_points(control: Sequence[ControlResidual]) -> CheckPoints | None:
    """Figures of the check points among `Adjusted.control`; None where there is none."""
    points = [c for c in control if c.check]
    wrong = control_blunders(points)
    residual_m = known_residuals_m(points)[~wrong]
    if not len(residual_m):
        return None
    shift_m = means(residual_m)
    return CheckPoints(
        count=len(residual_m),
        mean_shift_m=shift_m,
        scatter_m=np.sqrt(means((residual_m - shift_m) ** 2)),
        rmse_m=np.sqrt(means(residual_m**2)),
        blunders=tuple(p.name for p, its in zip(points, wrong, strict=True) if its),
    )
