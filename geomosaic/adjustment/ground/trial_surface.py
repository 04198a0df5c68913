"""One surface through tie points, as stiff and on what it is asked to be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.ground.smoothed_grid import SmoothedGrid
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.linear import pseudo_inverse
from geomosaic.projection.ground import GroundSurface

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
_TRIAL_ROUNDS = tuned(
    4,
    "rounds",
    "of new weights of a trial surface, whose misses are judged by their median",
)
_GROUND_SHARE = sourced(
    0.05,
    "weight",
    "of points above a ground that is laid below them, those below it have the rest of 1: with more it "
    "rises into the crowns, with less the lowest wrong matches carry it",
    "chosen within 0.001 to 0.1, which Eilers and Boelens 2005 (Baseline Correction with Asymmetric "
    "Least Squares Smoothing, unpublished report) call a good choice",
)
_LOWEST = tuned(
    0.4,
    "share of the points",
    "that show how ground scatters: with more, crowns are among them and the plane rises into them; "
    "with less, ground that is rough counts as wrong",
)


@dataclass(frozen=True, eq=False)
class Heights:
    """What a surface goes by; see `surface.tie_surface`. Each is equal to itself alone."""

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
    """A surface of one curving, the mean change of curvature in flying heights, and one standing."""

    heights: Heights
    spacing_m: float
    curving: float
    standing: tuple[int, float]
    rounds: int = _TRIAL_ROUNDS


def fitted(trial: Trial) -> GroundSurface:
    """The surface: see `surface.tie_surface`."""
    heights, spacing_m, (terms, off) = trial.heights, trial.spacing_m, trial.standing
    points_m, sd_up_m, low_m, height_m = heights.points_m, heights.sd_up_m, heights.low_m, heights.height_m
    cols, rows = (np.ceil((heights.high_m - low_m) / spacing_m).astype(int) + 1).tolist()
    at = (points_m[:, :2] - low_m) / spacing_m
    grid = SmoothedGrid(at, (rows, cols), spacing_m / height_m, trial.curving, off)
    even = even_ground(points_m, sd_up_m, terms)
    target, weight = points_m[:, 2] - even(points_m[:, 0], points_m[:, 1]), 1.0 / sd_up_m**2
    for _ in range(trial.rounds):
        nodes = grid.fitted(target, weight, height_m)
        miss = np.abs(target - grid.at_points(nodes))
        scale = np.maximum(sd_up_m, 1.5 * float(np.median(miss)))
        weight = 1.0 / (1.0 + (miss / (2.0 * scale)) ** 2) / scale**2
    east, north = (low_m[k] + spacing_m * np.arange(n) for k, n in enumerate((cols, rows)))
    up = grid.laid_out(nodes) + even(east, north[:, None])
    return GroundSurface("tie_surface", float(low_m[0]), float(low_m[1]), spacing_m, up)


def even_ground(points_m: Floats, sd_up_m: Floats, terms: int) -> Callable[[Floats, Floats], Floats]:
    """Up by east and north on the plane (3 terms) or paraboloid (6) of the ground: laid below the points by
    asymmetric least squares (Eilers and Boelens 2005), then by the points that lie about it."""
    middle, size_m = points_m[:, :2].mean(axis=0), float(np.ptp(points_m[:, :2], axis=0).max()) or 1.0

    def powers(east_m: Floats, north_m: Floats) -> Floats:
        e, n = np.broadcast_arrays((east_m - middle[0]) / size_m, (north_m - middle[1]) / size_m)
        return np.stack([np.ones_like(e), e, n, e * e, e * n, n * n][:terms])

    design, up = powers(points_m[:, 0], points_m[:, 1]), points_m[:, 2]

    def by(weight: Floats) -> Floats:
        weighed = design * weight
        return np.asarray(pseudo_inverse(weighed @ design.T, symmetric=True) @ (weighed @ up))

    found, above = by(np.ones(len(up))), np.zeros(len(up), dtype=bool)
    for k in range(30):
        before, above = above, up > found @ design
        if k and np.array_equal(above, before):
            break
        found = by(np.where(above, _GROUND_SHARE, 1.0 - _GROUND_SHARE))
    for _ in range(20):
        miss = up - found @ design
        low = miss[miss <= np.quantile(miss, _LOWEST)]
        scale = np.maximum(1.5 * float(np.median(np.abs(low - np.median(low)))), sd_up_m)
        found = by(1.0 / (1.0 + (miss / scale) ** 2) ** 2)
    return lambda east_m, north_m: np.asarray(np.tensordot(found, powers(east_m, north_m), 1))
