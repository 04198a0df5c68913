"""A smooth surface over a grid, from heights of points and the usual slopes and curvatures of land."""

from __future__ import annotations

from itertools import combinations_with_replacement
from math import comb

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.estimation.linear import cholesky_of_band, solve_band

_SLOPE = tuned(1.0, "m per m", "usual slope; less: hills are levelled; more: no return to level far out")
_PER_HEIGHT = tuned(
    20.0, "places a flying height", "at which slopes count; less: single points bend the land"
)
_REGULAR = tuned(1e-6, "usual slopes", "draws nodes to 0, so that those without points are determined")


class SmoothedGrid:
    """A surface over a grid of nodes, bilinear between them, with priors on slopes and third derivatives.

    Nodes are numbered along the shorter side: the normal matrix is a band as wide as three such sides.

    Args: at (p, 2): columns and rows of the points, as node numbers; shape: rows and columns of the nodes;
        spacing: of the nodes, in flying heights; curving: usual third derivative, 1 / flying height²; off:
        deviation of heights from 0 in flying heights, or 0 where they are free.
    """

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
        """Heights of the nodes from those of the points (p,) and weights (p,); height: the flying height, in
        the unit of both."""
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

    def laid_out(self, nodes: Floats) -> Floats:
        """Heights of the nodes as rows and columns."""
        grid = nodes.reshape(self._rows, self._cols)
        return grid.T if self._transposed else grid


def _stiffness(rows: int, cols: int, spacing: float, curving: float) -> dict[int, Floats]:
    """Normal matrix of slopes and third derivatives in flying heights, by distance below the diagonal; nodes
    count by their area, so that the grid's spacing does not matter."""
    out = {0: np.full((rows, cols), _REGULAR**2)}
    for order, usual in ((1, _SLOPE), (3, curving)):
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
