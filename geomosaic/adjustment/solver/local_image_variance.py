"""Where tie points are less sure than elsewhere: crowns in the wind beside ground that stands still."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import digamma, polygamma

from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.constants import tuned

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
_BESIDE = tuned(
    8,
    "points",
    "that show together how sure a place is: fewer leave it to chance, more reach beyond a crown",
)
_FEWEST = tuned(100, "points", "of a block, below which all count alike: too few to distinguish places")
_LEAST_PX = tuned(1e-4, "px", "of a point's residuals, so that exact ones have a logarithm")


def unrest(tracks: Tracks, points_m: Floats, length_px: Floats, counts: Bools) -> Floats:
    """How many times the median place's deviation image coordinates have about each point, (p,).

    Where all places are alike it is 1 for all: the logarithm of each point's variance is known as well as
    its redundancy allows (Bartlett and Kendall 1946, The statistical analysis of variance-heterogeneity and
    the logarithmic transformation), neighbours are taken together, and what their means scatter by beyond
    that is how much places differ; each is drawn to the middle accordingly (Efron and Morris 1975, Data
    analysis using Stein's estimator, section 2).

    Args: points_m (p, 3): the points; length_px, counts (m,): of each observation, its residual and whether
        it is a tie point's that has a say.
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
    beside = cKDTree(points_m[known, :2]).query(points_m[known, :2], k=_BESIDE)[1]
    variance = 1.0 / weight[beside].sum(axis=1)
    mean = (weight[beside] * found[beside]).sum(axis=1) * variance
    differ = max(float(np.var(mean) - variance.mean()), 0.0)
    out[known] = np.exp(0.5 * differ / (differ + variance) * (mean - np.median(mean)))
    return out
