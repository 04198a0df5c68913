"""How far the shape of a block may be off: its uncertainty but for place, turn and scale."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.solver.solution import Solution
from geomosaic.constants import tuned
from geomosaic.estimation.linear import orthonormal

Floats = NDArray[np.float64]
_POINTS = tuned(48, "tie points", "fewer: bends of a long block are missed; more: two columns each")
_LEAST_POINTS = tuned(4, "tie points", "a similarity takes four numbers of their eight")
_WELL_KNOWN = tuned(0.95, "share of the tie points", "more: wrong matches far out count; less: no rim")


def shape_sd_m(solution: Solution, ties: int) -> float:
    """Deviation of a tie point's place in plan after the best similarity, root mean square over the block.

    By the whole covariance of poses, lenses and readout, those held at what they were given included
    (`Reduced.considering`). NaN for less than four points.

    Args: ties: how many of the solution's points are tie points, which come first.
    """
    n = solution.reduced.normals
    f, d = n.pose_side.shape
    sd_m = np.linalg.norm(solution.points_sd_m[:ties, :2], axis=1)
    known = np.flatnonzero(sd_m <= np.quantile(sd_m, _WELL_KNOWN)) if ties else np.arange(0)
    chosen = known[_spread_out(solution.points_m[known, :2])]
    if len(chosen) < _LEAST_POINTS:
        return float("nan")
    plan = solution.points_m[chosen, :2]
    by_pose = np.zeros((f, d, 2 * len(chosen)))
    by_shared = np.zeros((len(solution.reduced.shared), 2 * len(chosen)))
    c, k = n.interior_side.shape
    for j, p in enumerate(chosen):
        inverse, columns = solution.reduced.points_inverse[p][:2], slice(2 * j, 2 * j + 2)
        for o in np.flatnonzero(n.sightings.point == p):
            by_pose[n.sightings.frame[o], :, columns] -= (inverse @ n.point_pose(int(o))).T
        by_shared[: c * k, columns] = -np.einsum("ai,cki->cka", inverse, n.interior_point[:, p]).reshape(
            -1, 2
        )
        by_shared[c * k, columns] = -inverse @ n.level_point[p]
    covariance = solution.reduced.propagate(by_pose, by_shared)
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
