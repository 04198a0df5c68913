"""The ground from adjusted tie points: one robust level, or a smooth robust surface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, diags, identity, kron
from scipy.sparse.linalg import splu

from geomosaic.projection.ground import GroundSurface, node_spacing_m

Floats = NDArray[np.float64]
_MOST_NODES, _MOST_TRIAL_NODES = 40_000, 4_000
_POINTS_PER_NODE = 3.0
_ROUNDS, _TRIAL_ROUNDS = 8, 4
_SLOPE = 1.0
_CURVINGS = (2.0, 4.0, 8.0, 16.0, 32.0)
_UNTOLD_CURVING = 8.0
_UNHELD = (3, 0.0)
_STANDINGS = (_UNHELD, (3, 0.0125), (6, 0.1), (6, 0.0125))
"""Tried: terms of what ground stands on, a plane (3) or a paraboloid (6), and how far it goes off it, in
flying heights; 0 where nothing holds it. Off a tenth go hills, off a hundredth what trees and houses leave of
even land."""
_GROUND_SHARE = 0.05
"""Of points above a ground that is laid below them; 0.01 to 0.1 is usual (Eilers and Boelens 2005)."""
_LOW, _LOWEST = 0.5, 0.4
"""Shares of the points: of those left out, what may be ground judges; the lowest tell how ground scatters."""
_FOLDS, _FEWEST = (1, 3), 10
_GAP = 0.2
_PER_HEIGHT = 20.0
_CAP = 10.0


def level_m(up_m: Floats, sd_m: Floats) -> float:
    """The height that most points share: a Cauchy-weighted mean from the median on."""
    level = float(np.median(up_m))
    for _ in range(20):
        scale = np.maximum(1.5 * float(np.median(np.abs(up_m - level))), sd_m)
        weight = 1.0 / (1.0 + ((up_m - level) / scale) ** 2) / sd_m**2
        level = float(np.average(up_m, weights=weight))
    return level


def tie_surface(
    points_m: Floats, sd_up_m: Floats, low_m: Floats, high_m: Floats, height_m: float
) -> GroundSurface:
    """Robust smoothing surface through tie points, a spline with tension (Mitášová and Mitáš 1993).

    Minimises sum rho((up - surface) / sd) over the points plus the squared slopes and third derivatives of
    the surface, each over what this ground does in the mean. Third derivatives let hills go on beyond the
    last points as they curve there, where second derivatives would go straight on; slopes bring the surface
    back to level further out. How much the curvature changes is found by cross-validation: every fifth
    square of a fifth of the flying height is left out and foretold by the others, as ground beyond the
    points has to be. In the same way it is found whether, and how strongly, a plane or a paraboloid laid
    below the points holds the surface, judged by low points: beyond a wood lies the ground it stands on, not
    its crowns. Lengths count in flying heights, so that a smaller block gets the same surface, smaller. The
    grid has about one node to three points; rho is Cauchy's, so that single trees, poles and wrong matches
    don't pull the ground.

    Args: points_m (p, 3), sd_up_m (p,), low_m and high_m (2,): the rectangle to cover, which may reach
        beyond the points; height_m: the frames' height above the points.
    """
    inside = np.ptp(points_m[:, :2], axis=0)
    spacing = float(np.sqrt(np.prod(inside) * _POINTS_PER_NODE / max(len(points_m), 1)))
    evens = {terms: _even(points_m, sd_up_m, terms) for terms in {terms for terms, _ in _STANDINGS}}
    task = _Task(points_m, sd_up_m, low_m, high_m, height_m, evens)
    trial_m = node_spacing_m(low_m, high_m, spacing, _MOST_TRIAL_NODES)
    curving = _curving(task, trial_m)
    standing = _standing(task, trial_m, curving)
    return task.fitted(node_spacing_m(low_m, high_m, spacing, _MOST_NODES), curving, standing, _ROUNDS)


@dataclass(frozen=True)
class _Task:
    """What `tie_surface` is asked for. evens: what the ground may stand on, by its number of terms."""

    points_m: Floats
    sd_up_m: Floats
    low_m: Floats
    high_m: Floats
    height_m: float
    evens: Mapping[int, Callable[[Floats, Floats], Floats]]

    def above(self, terms: int) -> Floats:
        """Heights of the points above what the ground may stand on."""
        return self.points_m[:, 2] - self.evens[terms](self.points_m[:, 0], self.points_m[:, 1])

    def fold(self, number: int) -> NDArray[np.bool_]:
        """The points in one square of five."""
        col, row = np.floor((self.points_m[:, :2] - self.low_m) / (_GAP * self.height_m)).astype(np.intp).T
        return np.asarray((col + 2 * row) % 5 == number)

    def foretold(self, spacing_m: float, curving: float, standing: tuple[int, float], fold: int) -> Floats:
        """By how much the surface of the other squares misses a fold's points; of too few, nothing."""
        out = self.fold(fold)
        if out.sum() < _FEWEST or out.all():
            return np.zeros(0)
        known = replace(self, points_m=self.points_m[~out], sd_up_m=self.sd_up_m[~out])
        trial, asked = known.fitted(spacing_m, curving, standing, _TRIAL_ROUNDS), self.points_m[out]
        return np.asarray(np.abs(asked[:, 2] - trial.up_at(asked[:, 0], asked[:, 1])))

    def fitted(
        self, spacing_m: float, curving: float, standing: tuple[int, float], rounds: int
    ) -> GroundSurface:
        """The surface of one curving, the mean change of curvature in flying heights, and one standing."""
        cols, rows = (np.ceil((self.high_m - self.low_m) / spacing_m).astype(int) + 1).tolist()
        design = _bilinear((self.points_m[:, :2] - self.low_m) / spacing_m, rows, cols)
        terms, off = standing
        target, height_m = self.above(terms), self.height_m
        stiff = _stiffness(rows, cols, spacing_m / height_m, curving) / height_m**2
        if off:
            held = _PER_HEIGHT * spacing_m / height_m / (off * height_m)
            stiff = stiff + held**2 * identity(rows * cols)
        weight = 1.0 / self.sd_up_m**2
        surface = np.zeros(rows * cols)
        for _ in range(rounds):
            normal = (design.T @ diags(weight) @ design + stiff).tocsc()
            factors = splu(normal, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
            surface = factors.solve(np.asarray(design.T @ (weight * target)))
            miss = np.abs(target - design @ surface)
            scale = np.maximum(self.sd_up_m, 1.5 * float(np.median(miss)))
            weight = 1.0 / (1.0 + (miss / (2.0 * scale)) ** 2) / scale**2
        east, north = (self.low_m[k] + spacing_m * np.arange(n) for k, n in enumerate((cols, rows)))
        up = surface.reshape(rows, cols) + self.evens[terms](east, north[:, None])
        return GroundSurface("tie_surface", float(self.low_m[0]), float(self.low_m[1]), spacing_m, up)


def _curving(task: _Task, spacing_m: float) -> float:
    """The curving that foretells points left out best: least mean miss, wild ones capped."""
    misses = [task.foretold(spacing_m, curving, _UNHELD, 0) for curving in _CURVINGS]
    if not len(misses[0]):
        return _UNTOLD_CURVING
    return _CURVINGS[int(np.argmin([np.minimum(m, _CAP * np.median(m)).mean() for m in misses]))]


def _standing(task: _Task, spacing_m: float, curving: float) -> tuple[int, float]:
    """The standing that foretells low points left out best, by the median: crowns are no ground."""
    above = task.above(max(terms for terms, _ in _STANDINGS))
    total = np.zeros(len(_STANDINGS))
    for fold in _FOLDS:
        of_fold = above[task.fold(fold)]
        for k, standing in enumerate(_STANDINGS):
            miss = task.foretold(spacing_m, curving, standing, fold)
            if not len(miss):
                return _UNHELD
            total[k] += np.median(miss[of_fold <= np.quantile(of_fold, _LOW)])
    return _STANDINGS[int(total.argmin())]


def _even(points_m: Floats, sd_up_m: Floats, terms: int) -> Callable[[Floats, Floats], Floats]:
    """Up by east and north on the plane (3 terms) or paraboloid (6) of the ground: laid below the points by
    asymmetric least squares (Eilers and Boelens 2005), then by the points that lie about it."""
    middle, size_m = points_m[:, :2].mean(axis=0), float(np.ptp(points_m[:, :2], axis=0).max()) or 1.0

    def powers(east_m: Floats, north_m: Floats) -> Floats:
        e, n = np.broadcast_arrays((east_m - middle[0]) / size_m, (north_m - middle[1]) / size_m)
        return np.stack([np.ones_like(e), e, n, e * e, e * n, n * n][:terms], axis=-1)

    design, up = powers(points_m[:, 0], points_m[:, 1]), points_m[:, 2]

    def by(weight: Floats) -> Floats:
        weighed = design * weight[:, None]
        return np.asarray(np.linalg.pinv(weighed.T @ design, hermitian=True) @ (weighed.T @ up))

    found = by(np.ones(len(up)))
    for _ in range(30):
        found = by(np.where(up > design @ found, _GROUND_SHARE, 1.0 - _GROUND_SHARE))
    for _ in range(20):
        miss = up - design @ found
        low = miss[miss <= np.quantile(miss, _LOWEST)]
        scale = np.maximum(1.5 * float(np.median(np.abs(low - np.median(low)))), sd_up_m)
        found = by(1.0 / (1.0 + (miss / scale) ** 2) ** 2)
    return lambda east_m, north_m: np.asarray(powers(east_m, north_m) @ found)


def _bilinear(at: Floats, rows: int, cols: int) -> csc_matrix:
    """The surface at grid coordinates (p, 2), col and row, from its nodes: (p, rows * cols)."""
    at = np.clip(at, 0.0, [cols - 1.001, rows - 1.001])
    j, i = np.floor(at).astype(np.intp).T
    dx, dy = (at - np.floor(at)).T
    node = i * cols + j
    entries = [(1 - dx) * (1 - dy), dx * (1 - dy), (1 - dx) * dy, dx * dy]
    nodes = [node, node + 1, node + cols, node + cols + 1]
    return coo_matrix(
        (np.concatenate(entries), (np.tile(np.arange(len(at)), 4), np.concatenate(nodes))),
        shape=(len(at), rows * cols),
    ).tocsc()


def _stiffness(rows: int, cols: int, spacing: float, curving: float) -> csc_matrix:
    """Normal matrix of slopes and third derivatives, lengths in flying heights; each node counts by its
    area, so that the surface doesn't depend on how fine the grid is."""
    total = 1e-12 * identity(rows * cols)
    for order, usual in ((1, _SLOPE), (3, curving)):
        for across in range(order + 1):
            part = kron(_differences(rows, across), _differences(cols, order - across))
            total = total + (comb(order, across) / (usual * spacing**order) ** 2) * (part.T @ part)
    return (total * (spacing * _PER_HEIGHT) ** 2).tocsc()


def _differences(n: int, order: int) -> csc_matrix:
    out = identity(n)
    for k in range(order):
        out = diags([-1.0, 1.0], [0, 1], shape=(max(n - k - 1, 0), n - k)) @ out
    return out.tocsc()
