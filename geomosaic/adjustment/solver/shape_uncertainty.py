"""How far the shape of a block may be off: its uncertainty but for place, turn and scale."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.problem.bundle_model import Bundle
from geomosaic.constants import tuned
from geomosaic.estimation.linear import orthonormal

Floats = NDArray[np.float64]
_POINTS = tuned(
    48,
    "tie points",
    "spread over the block: its shape bends and stretches over many of them; fewer miss bends of a long "
    "block, more cost two columns of the covariance each",
)
_LEAST_POINTS = tuned(
    4,
    "tie points",
    "a similarity takes four numbers of their eight; of fewer points next to no shape is left",
)
_WELL_KNOWN = tuned(
    0.95,
    "share of the tie points",
    "the best determined ones stand for the block: among the others are wrong matches far outside of "
    "it, by rays that hardly cut (one, known to 87 m, opened a block by 16 px that was 0.1 px off); "
    "with a smaller share the block's rim would not count",
)


def shape_sd_m(bundle: Bundle, ties: int) -> float:
    """Deviation of a tie point's place in plan after the best similarity, root mean square over the block.

    By the whole covariance of poses, lenses and readout, those held at what they were given included
    (`Reduced.considering`). NaN for less than four points.

    Args: ties: how many of the bundle's points are tie points, which come first.
    """
    n = bundle.reduced.normals
    f, d = n.pose_side.shape
    sd_m = np.linalg.norm(bundle.points_sd_m[:ties, :2], axis=1)
    known = np.flatnonzero(sd_m <= np.quantile(sd_m, _WELL_KNOWN)) if ties else np.arange(0)
    chosen = known[_spread_out(bundle.points_m[known, :2])]
    if len(chosen) < _LEAST_POINTS:
        return float("nan")
    plan = bundle.points_m[chosen, :2]
    by_pose = np.zeros((f, d, 2 * len(chosen)))
    by_shared = np.zeros((len(bundle.reduced.shared), 2 * len(chosen)))
    c, k = n.interior_side.shape
    for j, p in enumerate(chosen):
        inverse, columns = bundle.reduced.points_inverse[p][:2], slice(2 * j, 2 * j + 2)
        for o in np.flatnonzero(n.sightings.point == p):
            by_pose[n.sightings.frame[o], :, columns] -= (inverse @ n.point_pose(int(o))).T
        by_shared[: c * k, columns] = -np.einsum("ai,cki->cka", inverse, n.interior_point[:, p]).reshape(
            -1, 2
        )
        by_shared[c * k, columns] = -inverse @ n.level_point[p]
    covariance = bundle.reduced.propagate(by_pose, by_shared)
    east, north = (plan - plan.mean(axis=0)).T
    similar = np.zeros((2 * len(chosen), 4))
    similar[0::2] = np.column_stack([np.ones(len(chosen)), np.zeros(len(chosen)), east, -north])
    similar[1::2] = np.column_stack([np.zeros(len(chosen)), np.ones(len(chosen)), north, east])
    basis = orthonormal(similar)
    left = float(np.trace(covariance) - np.trace(basis.T @ covariance @ basis))
    return float(np.sqrt(max(left, 0.0) / len(chosen)))


def _spread_out(plan: Floats) -> NDArray[np.intp]:
    """Points far from each other, each the farthest from all before."""
    if not len(plan):
        return np.zeros(0, dtype=np.intp)
    chosen = [int(np.linalg.norm(plan - np.median(plan, axis=0), axis=1).argmin())]
    away = np.linalg.norm(plan - plan[chosen[0]], axis=1)
    while len(chosen) < min(_POINTS, len(plan)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(plan - plan[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.intp)
