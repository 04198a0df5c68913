"""Heights at the nodes of a grid, by points between them and by what land usually does."""

from __future__ import annotations

from functools import cached_property
from math import comb

import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import tuned
from geomosaic.estimation.linear import cholesky_of_band, solve_band

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_SLOPE = tuned(
    1.0,
    "m per m",
    "usual slope of land, to which slopes are held: steep, so that hills are not levelled, but the "
    "surface comes back to level far beyond the last points",
)
_PER_HEIGHT = tuned(
    20.0,
    "independent places a flying height",
    "along each axis at which slopes and third derivatives count: with more, what land usually does "
    "outweighs the points; with less, single points bend the surface",
)
_OF_ITSELF = tuned(
    1e-6,
    "usual slopes and third derivatives",
    "by which nodes are held to 0, so that those that no point reaches have a height; with more, they "
    "would come down to it",
)


class SmoothedGrid:
    """A surface over a grid of nodes, bilinear between them, held by its slopes and third derivatives.

    The nodes are numbered along the grid's shorter side, so that the equations are a band of three of its
    lengths (third derivatives reach as far), and are solved as one.

    Args: at (p, 2): columns and rows of the points, as node numbers; shape: rows and columns of the nodes;
        spacing: from node to node, in flying heights; curving: usual third derivative per flying height
        squared; off: how far heights go from 0, in flying heights, or 0 where they are free.
    """

    def __init__(
        self, at: Floats, shape: tuple[int, int], spacing: float, curving: float, off: float
    ) -> None:
        self._turned = shape[1] > shape[0]
        self._rows, self._cols = shape[::-1] if self._turned else shape
        self._stiff = _stiffness(self._rows, self._cols, spacing, curving)
        self._stiff[0] += (_PER_HEIGHT * spacing / off) ** 2 if off else 0.0
        at = np.clip(at[:, ::-1] if self._turned else at, 0.0, [self._cols - 1.001, self._rows - 1.001])
        col, row = np.floor(at).astype(np.intp).T
        dx, dy = (at - np.floor(at)).T
        first, cols = row * self._cols + col, self._cols
        self._node = np.stack([first, first + 1, first + cols, first + cols + 1])
        self._share = np.stack([(1 - dx) * (1 - dy), dx * (1 - dy), (1 - dx) * dy, dx * dy])

    def fitted(self, up: Floats, weight: Floats, height: float) -> Floats:
        """Heights of the nodes by those of the points (p,) with their weights; height: the flying height, in
        the unit of both."""
        n = self._rows * self._cols
        band = np.zeros((3 * self._cols + 1, n), order="F")
        for below, entries in self._stiff.items():
            band[below] = entries / height**2
        met, of_points = self._products
        for below, of_pairs in of_points.items():
            band[below] += np.bincount(met[below], (weight * of_pairs).ravel(), n)
        side = np.bincount(self._node.ravel(), (self._share * (weight * up)).ravel(), n).astype(np.float64)
        return solve_band(cholesky_of_band(band, lower=True, overwrite=True), side, lower=True)

    def at_points(self, nodes: Floats) -> Floats:
        """Heights at the points, (p,)."""
        return np.asarray((self._share * nodes[self._node]).sum(axis=0))

    def laid_out(self, nodes: Floats) -> Floats:
        """Heights of the nodes as rows and columns."""
        grid = nodes.reshape(self._rows, self._cols)
        return grid.T if self._turned else grid

    @cached_property
    def _products(self) -> tuple[dict[int, Ints], dict[int, Floats]]:
        """What points add to the equations for a weight of 1, by how far below the diagonal, each beside the
        node whose column it is."""
        pairs: dict[int, list[tuple[int, int]]] = {}
        steps = (0, 1, self._cols, self._cols + 1)
        for a in range(4):
            for b in range(a, 4):
                pairs.setdefault(steps[b] - steps[a], []).append((a, b))
        met = {below: np.concatenate([self._node[a] for a, _ in mine]) for below, mine in pairs.items()}
        of_points = {
            below: np.stack([self._share[a] * self._share[b] for a, b in mine])
            for below, mine in pairs.items()
        }
        return met, of_points


def _stiffness(rows: int, cols: int, spacing: float, curving: float) -> dict[int, Floats]:
    """Normal matrix of slopes and third derivatives, lengths in flying heights, by how far below the
    diagonal; each node counts by its area, so that the surface doesn't depend on how fine the grid is."""
    out = {0: np.full((rows, cols), _OF_ITSELF**2)}
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
    """Of n numbers' differences D of some order, D'D: [b, j] is its row j + b, column j; (order + 1, n)."""
    signs = [comb(order, m) * (-1) ** (order - m) for m in range(order + 1)]
    out, count = np.zeros((order + 1, n)), max(n - order, 0)
    for m in range(order + 1):
        for b in range(order + 1 - m):
            out[b, m : m + count] += signs[m] * signs[m + b]
    return out
