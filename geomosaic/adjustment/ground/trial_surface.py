"""One surface through tie points, of a given stiffness about a given plane or paraboloid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.ground.smoothed_grid import SmoothedGrid
from geomosaic.arrays import Bools, Floats
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.robust import irls
from geomosaic.projection.ground import GroundSurface

_TRIAL_ROUNDS = tuned(4, "rounds", "of re-weighting a trial surface, which is judged by medians")
_ABOVE = sourced(0.05, "weight", "above the ground; more: it rises into crowns", "Eilers and Boelens 2005")
_LOWEST = tuned(0.4, "share of the points", "that show the ground's scatter; more: crowns among them")


@dataclass(frozen=True, eq=False)
class Heights:
    """Points (p, 3) with deviations up (p,), the corners (2,) of the grid, the flying height; in metres."""

    points_m: Floats
    sd_up_m: Floats
    low_m: Floats
    high_m: Floats
    height_m: float

    def without(self, out: Bools) -> Heights:
        """The other points."""
        return replace(self, points_m=self.points_m[~out], sd_up_m=self.sd_up_m[~out])


@dataclass(frozen=True)
class Trial:
    """Parameters of one surface. curving: usual third derivative, 1 / flying height²; standing: terms of the
    trend (3 plane, 6 paraboloid) and deviation from it in flying heights, 0 for free."""

    heights: Heights
    spacing_m: float
    curving: float
    standing: tuple[int, float]
    rounds: int = _TRIAL_ROUNDS


def fitted(trial: Trial) -> GroundSurface:
    """The robust surface of a trial."""
    heights, spacing_m, (terms, off) = trial.heights, trial.spacing_m, trial.standing
    points_m, sd_up_m, low_m, height_m = heights.points_m, heights.sd_up_m, heights.low_m, heights.height_m
    cols, rows = (np.ceil((heights.high_m - low_m) / spacing_m).astype(int) + 1).tolist()
    at = (points_m[:, :2] - low_m) / spacing_m
    grid = SmoothedGrid(at, (rows, cols), spacing_m / height_m, trial.curving, off)
    trend = even_ground(points_m, sd_up_m, terms)
    target, weight = points_m[:, 2] - trend(points_m[:, 0], points_m[:, 1]), 1.0 / sd_up_m**2
    for _ in range(trial.rounds):
        nodes = grid.fitted(target, weight, height_m)
        miss = np.abs(target - grid.at_points(nodes))
        scale = np.maximum(sd_up_m, 1.5 * float(np.median(miss)))
        weight = 1.0 / (1.0 + (miss / (2.0 * scale)) ** 2) / scale**2
    east, north = (low_m[k] + spacing_m * np.arange(n) for k, n in enumerate((cols, rows)))
    up = grid.laid_out(nodes) + trend(east, north[:, None])
    return GroundSurface("tie_surface", float(low_m[0]), float(low_m[1]), spacing_m, up)


def even_ground(points_m: Floats, sd_up_m: Floats, terms: int) -> Callable[[Floats, Floats], Floats]:
    """Up by east and north of the ground's plane (3 terms) or paraboloid (6), below crowns.

    Asymmetric least squares first (Eilers and Boelens 2005), then robust weights about the lowest points.
    """
    middle, size_m = points_m[:, :2].mean(axis=0), float(np.ptp(points_m[:, :2], axis=0).max()) or 1.0

    def powers(east_m: Floats, north_m: Floats) -> Floats:
        e, n = np.broadcast_arrays((east_m - middle[0]) / size_m, (north_m - middle[1]) / size_m)
        return np.stack([np.ones_like(e), e, n, e * e, e * n, n * n][:terms], axis=-1)

    def asymmetric(left: Floats) -> Floats:
        return np.where(left > 0.0, _ABOVE, 1.0 - _ABOVE)

    def about_lowest(left: Floats) -> Floats:
        low = left[left <= np.quantile(left, _LOWEST)]
        scale = np.maximum(1.5 * float(np.median(np.abs(low - np.median(low)))), sd_up_m)
        return np.asarray(1.0 / (1.0 + (left / scale) ** 2) ** 2)

    design, up = powers(points_m[:, 0], points_m[:, 1]), points_m[:, 2]
    found, _ = irls(design, up, np.ones_like, rounds=1)
    for weigh, rounds in ((asymmetric, 30), (about_lowest, 20)):
        found, _ = irls(design, up, weigh, found, rounds)
    return lambda east_m, north_m: np.asarray(powers(east_m, north_m) @ found)
