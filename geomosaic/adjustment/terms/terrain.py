"""A surface that tie points lie on, up to one level."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from geomosaic.adjustment.kernels.normal_equations import Normals
from geomosaic.adjustment.kernels.reduced_equations import Reduced
from geomosaic.adjustment.problem.estimate import Estimate, Step, Unknowns
from geomosaic.adjustment.terms.term import Components, Term
from geomosaic.arrays import Bools, Floats
from geomosaic.estimation.robust import cauchy_cost, cauchy_weight, median_of_known
from geomosaic.projection.ground import GroundSurface

LEVEL = "ground level"


def level_unknown(sd_m: float) -> Unknowns:
    """The ground's level with a prior deviation."""
    return Unknowns(LEVEL, "ground", ("level_m",), np.zeros(1), np.full(1, sd_m), optional=False)


@dataclass(frozen=True)
class Terrain(Term):
    """Tie points lie on a surface, up to one common level. Cauchy's function outweighs trees and roofs, which
    are far against the bulk of the points, never all at once: else land would free itself from its level.
    sd_share: deviation of a point from the surface by the frames' mean height above it (in metres it would be
    smaller for a shrinking block). level_sd_m: of the surface as a whole. bound (p,): which points lie on it.
    frame_share (f,): each frame's share of all observations, its weight in the mean height. places: how many
    independent points all of them together count as, since near ones err alike; at most their number. bulk:
    what the points are off by in common, 1 or more stated deviations, see `weighed`."""

    ground: GroundSurface
    sd_share: float
    level_sd_m: float
    bound: Bools
    frame_share: Floats
    places: float = np.inf
    bulk: float = 1.0

    name: ClassVar[str] = "terrain"

    def miss_m(self, points_m: Floats, level_m: float) -> Floats:
        """Surface plus level minus point, along the vertical, (p,)."""
        return np.asarray(self.ground.up_at(points_m[:, 0], points_m[:, 1]) + level_m - points_m[:, 2])

    def height_m(self, at: Estimate) -> float:
        """Mean height of the frames above the surface and its level, 1 m at least."""
        surface = self.ground.up_at(at.positions_m[:, 0], at.positions_m[:, 1])
        return max(float(self.frame_share @ (at.positions_m[:, 2] - surface)) - at.level_m, 1.0)

    def sd_m(self, at: Estimate) -> float:
        """Deviation of a point from the surface."""
        return self.sd_share * self.height_m(at)

    def weighed(self, at: Estimate) -> Terrain:
        """With the bulk of an estimate, where all points count as one. Of a DEM, woods may cover all."""
        if self.places > 1.0:
            return self
        common_m = median_of_known(self.miss_m(at.points_m[self.bound], at.level_m))
        bulk = max(1.0, abs(common_m) / self.sd_m(at))
        return self if bulk == self.bulk else replace(self, bulk=bulk)

    @cached_property
    def point_weight(self) -> float:
        """What the cost of a point counts for."""
        return min(1.0, self.places / max(int(self.bound.sum()), 1))

    def cost(self, at: Estimate, components: Components) -> float:
        return float(self.cost_of(at.points_m[self.bound], self.sd_m(at), at.level_m).sum())

    def cost_of(self, points_m: Floats, sd_m: float, level_m: float) -> Floats:
        """Of each of some points (p, 3) on the surface, (p,)."""
        length = self.miss_m(points_m, level_m) / (self.bulk * sd_m)
        return self.point_weight * self.bulk**2 * cauchy_cost(length)

    def add_to(self, normals: Normals, at: Estimate, components: Components) -> Normals:
        """Adds each point's equation: up minus slope times place minus level, observed as the surface. The
        deviation grows with the flying height, so the cost has a slope along it. This slope lifts the frames
        and lowers the level by what the residuals would gain if the block shrank; see `solved`."""
        height = self.height_m(at)
        weight, miss, normal = self.rows(at.points_m, self.bound, self.sd_share * height, at.level_m)
        normals.points[:] += weight[:, None, None] * normal[:, :, None] * normal[:, None, :]
        normals.point_side[:] += (weight * miss)[:, None] * normal
        lift = float((weight * miss**2).sum()) / height
        normals.pose_side[:, 2] += lift * self.frame_share
        return replace(
            normals,
            level_point=-weight[:, None] * normal,
            level=normals.level + float(weight.sum()),
            level_side=normals.level_side - float((weight * miss).sum()) - lift,
        )

    def solved(
        self, reduced: Reduced, at: Estimate, solution: Callable[[Reduced], Step]
    ) -> tuple[Reduced, Step]:
        """The equations with the slope along the flying height by the residuals that their solution leaves,
        and that solution; at the minimum they are the same. By the residuals before, a step would lift the
        block by per cents. What is left is linear in the lift."""
        height, level = self.height_m(at), reduced.level
        weight, miss, normal = self.rows(at.points_m, self.bound, self.sd_share * height, at.level_m)
        by_height = weight * miss / height

        def lifted(lift: float) -> Reduced:
            pose_side, shared_side = reduced.pose_side.copy(), reduced.shared_side.copy()
            pose_side.reshape(len(self.frame_share), -1)[:, 2] += lift * self.frame_share
            shared_side[level] -= lift
            return reduced.with_sides(pose_side, shared_side)

        def slope(step: Step) -> float:
            return float(by_height @ (miss + step.shared[level] - (normal * step.points).sum(axis=1)))

        present, moved = float(by_height @ miss), solution(reduced)
        still = solution(lifted(-present))
        left = present - (slope(moved) - slope(still))
        if not left > 0.0:
            return reduced, moved
        share = slope(still) / left
        return lifted((share - 1.0) * present), still.towards(moved, share)

    def rows(
        self, points_m: Floats, bound: Bools, sd_m: float, level_m: float
    ) -> tuple[Floats, Floats, Floats]:
        """Weights (p,), residuals in m (p,) and the surface's normals with up 1 (p, 3)."""
        miss = self.miss_m(points_m, level_m)
        weight = self.point_weight * cauchy_weight(miss / (self.bulk * sd_m)) / sd_m**2
        weight = np.where(bound, weight, 0.0)
        step, (e, n) = self.ground.spacing_m, points_m[:, :2].T
        up = self.ground.up_at
        normal = np.column_stack(
            [
                (up(e - step / 2, n) - up(e + step / 2, n)) / step,
                (up(e, n - step / 2) - up(e, n + step / 2)) / step,
                np.ones(len(e)),
            ]
        )
        return weight, miss, normal


def surface_share(normals: Normals, points_inverse: Floats) -> float:
    """How many of the points' unknowns the surface determines rather than the images. It is the trace of the
    surface's part in each point's covariance, with poses and cameras fixed. A surface that hardly binds gives
    0, a hard one 1 a point."""
    weight = np.maximum(-normals.level_point[:, 2], 1e-300)
    along = np.einsum("pi,pij,pj->p", normals.level_point, points_inverse, normals.level_point)
    return float((along / weight).sum())
