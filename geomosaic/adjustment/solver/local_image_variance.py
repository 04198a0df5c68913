"""Image variances by neighbourhood: crowns in the wind beside firm ground."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import digamma, polygamma

from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.arrays import Bools, Floats
from geomosaic.constants import tuned

_NEIGHBOURS = tuned(8, "points", "fewer: chance; more: they reach beyond a crown")
_FEWEST = tuned(100, "points", "of a block; fewer: places cannot be distinguished")
_LEAST_PX = tuned(1e-4, "px", "of a point's residuals, so that exact ones have a logarithm")


def local_factors(tracks: Tracks, points_m: Floats, length_px: Floats, counts: Bools) -> Floats:
    """Factor of the image deviation about each point, (p,), 1 at the median place.

    The logarithm of each point's variance is known as well as its redundancy allows (Bartlett and Kendall
    1946, The statistical analysis of variance-heterogeneity and the logarithmic transformation). Neighbours
    are averaged. Their means are shrunk to the median by how much more they scatter than chance explains
    (Efron and Morris 1975, Data analysis using Stein's estimator, section 2).

    Args: points_m (p, 3). length_px, counts (m,): of each observation, its residual and whether it counts.
    """
    out = np.ones(len(points_m))
    use = counts & np.isfinite(length_px)
    views = np.bincount(tracks.point[use], minlength=len(out))
    squares = np.bincount(tracks.point[use], length_px[use] ** 2, minlength=len(out))
    known = np.flatnonzero(views >= 2)
    if len(known) < _FEWEST:
        return out
    freedom = 2.0 * views[known] - 3.0
    found = np.log(np.maximum(squares[known] / freedom, _LEAST_PX**2))
    found -= digamma(freedom / 2.0) - np.log(freedom / 2.0)
    weight = 1.0 / polygamma(1, freedom / 2.0)
    near = cKDTree(points_m[known, :2]).query(points_m[known, :2], k=_NEIGHBOURS)[1]
    variance = 1.0 / weight[near].sum(axis=1)
    mean = (weight[near] * found[near]).sum(axis=1) * variance
    differ = max(float(np.var(mean) - variance.mean()), 0.0)
    out[known] = np.exp(0.5 * differ / (differ + variance) * (mean - np.median(mean)))
    return out
