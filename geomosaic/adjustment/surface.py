"""The ground from adjusted tie points: flat where relief doesn't matter, else a smooth robust surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, diags, identity, kron, vstack
from scipy.sparse.linalg import splu

from geomosaic.projection.ground import GroundSurface

Floats = NDArray[np.float64]
_MOST_NODES = 40_000
_POINTS_PER_NODE = 3.0


def level_m(up_m: Floats, sd_m: Floats) -> float:
    """The height that most points share: a Cauchy-weighted mean from the median on."""
    level = float(np.median(up_m))
    for _ in range(20):
        scale = np.maximum(1.5 * float(np.median(np.abs(up_m - level))), sd_m)
        weight = 1.0 / (1.0 + ((up_m - level) / scale) ** 2) / sd_m**2
        level = float(np.average(up_m, weights=weight))
    return level


def tie_surface(
    points_m: Floats,
    sd_up_m: Floats,
    low_m: Floats,
    high_m: Floats,
    stiffness_m: float,
    stiff_spacing_m: float,
) -> GroundSurface:
    """Robust smoothing surface through tie points.

    Minimises sum rho((up - surface) / sd) over the points plus the squared second differences of the
    nodes over what one node may bend in the mean against its neighbours: stiffness_m, and where nodes lie
    further apart than stiff_spacing_m more with their distance squared, as one curvature does. The grid has
    about one node to three points; rho is Cauchy's, so that single trees, poles and wrong matches don't
    pull the ground.

    Args: points_m (p, 3), sd_up_m (p,), low_m and high_m (2,): the rectangle to cover.
    """
    extent = high_m - low_m
    inside = np.ptp(points_m[:, :2], axis=0)
    spacing = float(np.sqrt(np.prod(inside) * _POINTS_PER_NODE / max(len(points_m), 1)))
    spacing = max(spacing, float(np.sqrt(np.prod(extent) / _MOST_NODES)))
    stiffness_m *= max(spacing / stiff_spacing_m, 1.0) ** 2
    cols, rows = (np.ceil(extent / spacing).astype(int) + 1).tolist()
    at = np.clip((points_m[:, :2] - low_m) / spacing, 0.0, [cols - 1.001, rows - 1.001])
    j, i = np.floor(at).astype(np.intp).T
    dx, dy = (at - np.floor(at)).T
    k = np.arange(len(points_m))
    design = coo_matrix(
        (
            np.concatenate([(1 - dx) * (1 - dy), dx * (1 - dy), (1 - dx) * dy, dx * dy]),
            (
                np.tile(k, 4),
                np.concatenate([i * cols + j, i * cols + j + 1, (i + 1) * cols + j, (i + 1) * cols + j + 1]),
            ),
        ),
        shape=(len(k), rows * cols),
    ).tocsc()
    bend = _second_differences(rows, cols)
    level = level_m(points_m[:, 2], sd_up_m)
    target = points_m[:, 2] - level
    stiff = (bend.T @ bend) / stiffness_m**2 + 1e-9 * identity(rows * cols)
    weight = 1.0 / sd_up_m**2
    surface = np.zeros(rows * cols)
    for _ in range(8):
        normal = design.T @ diags(weight) @ design + stiff
        surface = splu(normal.tocsc()).solve(np.asarray(design.T @ (weight * target)))
        miss = np.abs(target - design @ surface)
        scale = np.maximum(sd_up_m, 1.5 * float(np.median(miss)))
        weight = 1.0 / (1.0 + (miss / (2.0 * scale)) ** 2) / scale**2
    up = surface.reshape(rows, cols) + level
    return GroundSurface("tie_surface", float(low_m[0]), float(low_m[1]), spacing, up)


def _second_differences(rows: int, cols: int) -> csc_matrix:
    def along(n: int) -> csc_matrix:
        return diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(max(n - 2, 0), n)).tocsc()

    def first(n: int) -> csc_matrix:
        return diags([-1.0, 1.0], [0, 1], shape=(n - 1, n)).tocsc()

    return vstack(
        [
            kron(identity(rows), along(cols)),
            kron(along(rows), identity(cols)),
            np.sqrt(2.0) * kron(first(rows), first(cols)),
        ]
    ).tocsc()
