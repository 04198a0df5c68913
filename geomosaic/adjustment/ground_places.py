"""Places spread over the mapped ground, and how sure they are together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.estimation.linear import orthonormal


@dataclass(frozen=True)
class GroundPlaces:
    """Places spread over the mapped ground, places_m (k, 3) east, north, up in the work frame, and their
    joint covariance_m2 (3 k, 3 k) by place, then axis."""

    places_m: Floats
    covariance_m2: Floats

    def with_common_error(self, common_m2: Floats) -> GroundPlaces:
        """With a variance (3,) that all places share."""
        common = np.tile(np.diag(common_m2), (len(self.places_m), len(self.places_m)))
        return replace(self, covariance_m2=self.covariance_m2 + common)

    def plan_m2(self, *, after_similarity: bool = False) -> Floats:
        """The covariance in plan, (2 k, 2 k) by place, then axis; of what the best similarity leaves."""
        plan = np.delete(np.arange(3 * len(self.places_m)), np.s_[2::3])
        covariance = self.covariance_m2[np.ix_(plan, plan)]
        if not after_similarity:
            return covariance
        basis = orthonormal(self.similar())
        left = np.eye(len(plan)) - basis @ basis.T
        return left @ covariance @ left

    def shape_sd_m(self) -> float:
        """Deviation of a place in plan after the best similarity, root mean square over the block."""
        left_m2 = max(float(np.trace(self.plan_m2(after_similarity=True))), 0.0)
        return float(np.sqrt(left_m2 / len(self.places_m)))

    def similar(self) -> Floats:
        """What shifts east and north, scale and turn do to places in plan, (2 k, 4): by place, then axis."""
        east, north = (self.places_m[:, :2] - self.places_m[:, :2].mean(axis=0)).T
        zero, one = np.zeros(len(east)), np.ones(len(east))
        to_east, to_north = [one, zero, east, -north], [zero, one, north, east]
        return np.stack([np.column_stack(to_east), np.column_stack(to_north)], axis=1).reshape(-1, 4)
