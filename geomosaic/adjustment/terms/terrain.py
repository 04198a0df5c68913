"""A surface that tie points lie on, as observations of a bundle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.solver.normal_equations import Normals
from geomosaic.estimation.robust import cauchy_cost, cauchy_weight
from geomosaic.projection.ground import GroundSurface

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Terrain:
    """Tie points lie on this surface, but for one level that is common to all of them.

    sd_share: how far a point lies off the surface, as a share of the frames' mean height above it; what
    stands up (trees, roofs) is outweighed by Cauchy's function. A deviation in metres would be smaller
    than it is for a block that shrinks, and so make every block shrink. level_sd_m: of the surface as a
    whole.
    """

    ground: GroundSurface
    sd_share: float
    level_sd_m: float

    def miss_m(self, points_m: Floats, level_m: float) -> Floats:
        """Surface plus level minus point, along the vertical, (p,)."""
        return np.asarray(self.ground.up_at(points_m[:, 0], points_m[:, 1]) + level_m - points_m[:, 2])

    def height_m(self, positions_m: Floats, frame_share: Floats, level_m: float) -> float:
        """Mean height of the frames above the surface and its level.

        Args: frame_share (f,): each frame's share of all observations, so that a frame that sees nothing
            has no say in what deviation the points have.
        """
        surface = self.ground.up_at(positions_m[:, 0], positions_m[:, 1])
        return max(float(frame_share @ (positions_m[:, 2] - surface)) - level_m, 1.0)


def terrain_cost(
    terrain: Terrain,
    bound: NDArray[np.bool_],
    points_m: Floats,
    positions_m: Floats,
    frame_share: Floats,
    level_m: float,
) -> float:
    """What points off the surface and its level off its prior add to the sum of squares."""
    sd_m = terrain.sd_share * terrain.height_m(positions_m, frame_share, level_m)
    miss = terrain.miss_m(points_m[bound], level_m) / sd_m
    return float(cauchy_cost(miss).sum()) + (level_m / terrain.level_sd_m) ** 2


def add_terrain(
    n: Normals,
    terrain: Terrain,
    bound: NDArray[np.bool_],
    points_m: Floats,
    positions_m: Floats,
    frame_share: Floats,
    level_m: float,
) -> Normals:
    """Each point's equation: up minus slope times place minus level, observed as the surface says.

    Since the deviation grows with the flying height, the cost has a slope along it: it lifts the frames
    and lowers the level by just what the misses would gain if the block shrank.

    Args: bound (p,): which points lie on the surface.
    """
    height = terrain.height_m(positions_m, frame_share, level_m)
    weight, miss, normal = terrain_rows(terrain, bound, points_m, terrain.sd_share * height, level_m)
    n.points[:] += weight[:, None, None] * normal[:, :, None] * normal[:, None, :]
    n.point_side[:] += (weight * miss)[:, None] * normal
    lift = float((weight * miss**2).sum()) / height
    n.pose_side[:, 2] += lift * frame_share
    level_weight = 1.0 / terrain.level_sd_m**2
    return replace(
        n,
        level_point=-weight[:, None] * normal,
        level=float(weight.sum()) + level_weight,
        level_side=-float((weight * miss).sum()) - level_weight * level_m - lift,
    )


def terrain_rows(
    terrain: Terrain, bound: NDArray[np.bool_], points_m: Floats, sd_m: float, level_m: float
) -> tuple[Floats, Floats, Floats]:
    """Weights (p,), misses in m (p,) and the surface's normals, up being 1, (p, 3), of `add_terrain`."""
    miss = terrain.miss_m(points_m, level_m)
    weight = np.where(bound, cauchy_weight(miss / sd_m) / sd_m**2, 0.0)
    step, (e, u) = terrain.ground.spacing_m, points_m[:, :2].T
    at = terrain.ground.up_at
    normal = np.column_stack(
        [
            (at(e - step / 2, u) - at(e + step / 2, u)) / step,
            (at(e, u - step / 2) - at(e, u + step / 2)) / step,
            np.ones(len(e)),
        ]
    )
    return weight, miss, normal


def surface_share(n: Normals, points_inverse: Floats) -> float:
    """How many of the points' unknowns the surface determines rather than the images.

    The trace of the surface's part in each point's covariance, with poses and cameras held: near 0 for a
    surface that hardly binds, near 1 a point for one that the points can't leave.
    """
    weight = np.maximum(-n.level_point[:, 2], 1e-300)
    along = np.einsum("pi,pij,pj->p", n.level_point, points_inverse, n.level_point)
    return float((along / weight).sum())
