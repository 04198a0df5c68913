"""How far places on the ground may be off: their joint covariance by poses, lenses and shutter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.adjustment.model import GroundPlaces
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.arrays import Floats, Ints
from geomosaic.constants import tuned
from geomosaic.estimation.robust import median_of_known

_POINTS = tuned(48, "tie points", "fewer: bends of a long block are missed; more: three columns each")
_LEAST_POINTS = tuned(4, "tie points", "a similarity takes four numbers of their eight")
_WELL_KNOWN = tuned(3.0, "times the median deviation of a point", "more: rays that hardly cut; less: no rim")


@dataclass(frozen=True)
class PlaceDerivatives:
    """Of tie points (k, 3) far from each other, by poses (f, d, 3 k) and shared unknowns (s, 3 k): by place,
    then axis; without the noise of the points' own image coordinates, which a map does not have."""

    places_m: Floats
    by_pose: Floats
    by_shared: Floats


def place_derivatives(solution: Solution, ties: int) -> PlaceDerivatives | None:
    """Of places spread over the block; None for less than four points.

    Args: ties: how many of the solution's points are tie points, which come first.
    """
    reduced = solution.stated.solved
    n = reduced.normals
    f, d = n.pose_side.shape
    sd_m = np.linalg.norm(solution.points_sd_m[:ties], axis=1)
    known = np.flatnonzero(sd_m <= _WELL_KNOWN * median_of_known(sd_m))
    chosen = known[_spread_out(solution.points_m[known, :2])]
    if len(chosen) < _LEAST_POINTS:
        return None
    by_pose = np.zeros((f, d, 3 * len(chosen)))
    by_shared = np.zeros((len(reduced.shared), 3 * len(chosen)))
    c, k = n.interior_side.shape
    for j, p in enumerate(chosen):
        inverse, columns = reduced.points_inverse[p], slice(3 * j, 3 * j + 3)
        for o in np.flatnonzero(n.sightings.point == p):
            by_pose[n.sightings.frame[o], :, columns] -= (inverse @ n.point_pose(int(o))).T
        by_interior = np.einsum("ai,cki->cka", inverse, n.interior_point[:, p])
        by_shared[: c * k, columns] = -by_interior.reshape(-1, 3)
        by_shared[c * k, columns] = -inverse @ n.level_point[p]
    return PlaceDerivatives(solution.points_m[chosen], by_pose, by_shared)


def ground_places(solution: Solution, ties: int) -> GroundPlaces | None:
    """Tie points far from each other, and by how much poses and lenses leave their places open.

    By the whole covariance of what frames share, those held at what they were given included
    (`Reduced.considering`). None for less than four points.

    Raises: NotSolvableError where the equations have no solution.
    """
    its = place_derivatives(solution, ties)
    if its is None:
        return None
    return GroundPlaces(its.places_m, solution.stated.reduced.propagate(its.by_pose, its.by_shared))


def _spread_out(plan: Floats) -> Ints:
    """Points far from each other, each the farthest from all before."""
    if not len(plan):
        return np.zeros(0, dtype=np.intp)
    chosen = [int(np.linalg.norm(plan - np.median(plan, axis=0), axis=1).argmin())]
    away = np.linalg.norm(plan - plan[chosen[0]], axis=1)
    while len(chosen) < min(_POINTS, len(plan)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(plan - plan[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.intp)
