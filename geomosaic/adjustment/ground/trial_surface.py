"""One surface through tie points, of a given stiffness about a given plane or paraboloid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from math import comb

import numpy as np

from geomosaic.arrays import Bools, Floats
from geomosaic.constants import NORMAL_PER_MAD, SLIGHT, sourced, tuned
from geomosaic.estimation.linear import cholesky_of_band, solve_band
from geomosaic.estimation.robust import cauchy_weight, irls
from geomosaic.projection.ground import GroundSurface

_PER_HEIGHT = tuned(20.0, "places a flying height", "where slopes count; less: points bend the land")
_TRIAL_ROUNDS = tuned(4, "rounds", "of re-weighting a trial surface, which is judged by medians")
_ABOVE = sourced(0.05, "weight", "above the ground; more: it rises into crowns", "Eilers and Boelens 2005")
_EVEN_POINTS = sourced(5_000, "points", "give their scatter to 1.7 %", "Rousseeuw and Croux 1993: 1.17/√n")
_LOWEST = tuned(0.4, "share of the points", "that show the ground's scatter; more: crowns among them")


class SmoothedGrid:
    """A surface over a grid of nodes, bilinear between them, with priors on slopes and third derivatives.
    Nodes are numbered along the shorter side, so that the normal matrix is a band. Args: at (p, 2): columns
    and rows of the points, as node numbers; shape: rows and columns of the nodes; spacing: of the nodes, in
    flying heights; curving: usual third derivative, 1 / flying height²; off: deviation of heights from 0 in
    flying heights, or 0 where they are free."""

    def __init__(
        self, at: Floats, shape: tuple[int, int], spacing: float, curving: float, off: float
    ) -> None:
        self._transposed = shape[1] > shape[0]
        self._rows, self._cols = shape[::-1] if self._transposed else shape
        self._stiff = _stiffness(self._rows, self._cols, spacing, curving)
        self._stiff[0] += (_PER_HEIGHT * spacing / off) ** 2 if off else 0.0
        at = np.clip(at[:, :: -1 if self._transposed else 1], 0.0, [self._cols - 1.001, self._rows - 1.001])
        col, row = np.floor(at).astype(np.intp).T
        dx, dy = (at - np.floor(at)).T
        self._steps = (0, 1, self._cols, self._cols + 1)
        self._node = np.add.outer(self._steps, row * self._cols + col)
        self._share = np.stack([(1 - dx) * (1 - dy), dx * (1 - dy), (1 - dx) * dy, dx * dy])

    def fitted(self, up: Floats, weight: Floats, height: float) -> Floats:
        """Heights of the nodes from those of the points (p,) and weights (p,); height: of flying, all in
        m."""
        n = self._rows * self._cols
        band = np.zeros((3 * self._cols + 1, n), order="F")
        for below, entries in self._stiff.items():
            band[below] = entries / height**2
        for a, b in combinations_with_replacement(range(4), 2):
            products = weight * (self._share[a] * self._share[b])
            band[self._steps[b] - self._steps[a]] += np.bincount(self._node[a], products, n)
        side = np.bincount(self._node.ravel(), (self._share * (weight * up)).ravel(), n).astype(np.float64)
        return solve_band(cholesky_of_band(band, lower=True, overwrite=True), side, lower=True)

    def at_points(self, nodes: Floats) -> Floats:
        """Heights at the points, (p,)."""
        return np.asarray((self._share * nodes[self._node]).sum(axis=0))

    def arranged(self, nodes: Floats) -> Floats:
        """Heights of the nodes as rows and columns."""
        grid = nodes.reshape(self._rows, self._cols)
        return grid.T if self._transposed else grid


def _stiffness(rows: int, cols: int, spacing: float, curving: float) -> dict[int, Floats]:
    """Normal matrix of slopes (of 1) and third derivatives in flying heights, by distance below the diagonal;
    nodes count by their area, so that the grid's spacing does not matter."""
    out = {0: np.full((rows, cols), SLIGHT**2)}
    for order, usual in ((1, 1.0), (3, curving)):
        for across in range(order + 1):
            down, along = _squares(rows, across), _squares(cols, order - across)
            scale = comb(order, across) / (usual * spacing**order) ** 2
            for a, of_rows in enumerate(down):
                for b in range(1 - min(len(along), cols) if a else 0, min(len(along), cols)):
                    of_cols = along[b] if b >= 0 else np.roll(along[-b], -b)
                    below = out.setdefault(a * cols + b, np.zeros((rows, cols)))
                    below += scale * of_rows[:, None] * of_cols
    return {below: entries.ravel() * (spacing * _PER_HEIGHT) ** 2 for below, entries in out.items()}


def _squares(n: int, order: int) -> Floats:
    """D'D (order + 1, n) of the differences D of n numbers: [b, j] is its row j + b, column j."""
    signs = [comb(order, m) * (-1) ** (order - m) for m in range(order + 1)]
    out, count = np.zeros((order + 1, n)), max(n - order, 0)
    for m in range(order + 1):
        for b in range(order + 1 - m):
            out[b, m : m + count] += signs[m] * signs[m + b]
    return out


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
    trend (3 plane, 6 paraboloid, 0 none) and deviation from it in flying heights, 0 for free."""

    heights: Heights
    spacing_m: float
    curving: float
    standing: tuple[int, float]
    rounds: int = _TRIAL_ROUNDS

    @property
    def nodes(self) -> tuple[int, int]:
        """Columns and rows of the grid."""
        cols, rows = np.ceil((self.heights.high_m - self.heights.low_m) / self.spacing_m).astype(int) + 1
        return int(cols), int(rows)


def fitted(trial: Trial) -> GroundSurface:
    """The robust surface of a trial."""
    heights, spacing_m, (terms, off) = trial.heights, trial.spacing_m, trial.standing
    points_m, sd_up_m, low_m, height_m = heights.points_m, heights.sd_up_m, heights.low_m, heights.height_m
    cols, rows = trial.nodes
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
    up = grid.arranged(nodes) + trend(east, north[:, None])
    return GroundSurface("tie_surface", float(low_m[0]), float(low_m[1]), spacing_m, up)


def even_ground(points_m: Floats, sd_up_m: Floats, terms: int) -> Callable[[Floats, Floats], Floats]:
    """Up by east and north of the ground's plane (3 terms) or paraboloid (6), below crowns; 0 without terms.
    Fitted by asymmetric least squares (Eilers and Boelens 2005), then with robust weights about the lowest
    points; both weigh points by how well their heights are known. Of many points, every n-th counts."""
    if not terms:
        return lambda east_m, north_m: np.zeros(np.broadcast_shapes(np.shape(east_m), np.shape(north_m)))
    every = -(-len(points_m) // _EVEN_POINTS) or 1
    points_m, sd_up_m = points_m[::every], sd_up_m[::every]
    middle, size_m = points_m[:, :2].mean(axis=0), float(np.ptp(points_m[:, :2], axis=0).max()) or 1.0

    def powers(east_m: Floats, north_m: Floats) -> Floats:
        e, n = np.broadcast_arrays((east_m - middle[0]) / size_m, (north_m - middle[1]) / size_m)
        return np.stack([np.ones_like(e), e, n, e * e, e * n, n * n][:terms], axis=-1)

    def asymmetric(left: Floats) -> Floats:
        scale = np.maximum(NORMAL_PER_MAD * float(np.median(np.abs(left))), SLIGHT)
        known = cauchy_weight(left / scale) / (1.0 + (sd_up_m / scale) ** 2)
        return np.asarray(np.where(left > 0.0, _ABOVE, 1.0 - _ABOVE) * known)

    def about_lowest(left: Floats) -> Floats:
        low = left[left <= np.quantile(left, _LOWEST)]
        scale = np.maximum(1.5 * float(np.median(np.abs(low - np.median(low)))), sd_up_m)
        return np.asarray(1.0 / (1.0 + (left / scale) ** 2) ** 2 / scale**2)

    design, up = powers(points_m[:, 0], points_m[:, 1]), points_m[:, 2]
    found = np.zeros(terms)
    found[0] = np.median(up)
    for weigh, rounds in ((asymmetric, 30), (about_lowest, 20)):
        found, _ = irls(design, up, weigh, found, rounds)
    return lambda east_m, north_m: np.asarray(powers(east_m, north_m) @ found)
