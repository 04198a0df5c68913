"""By how much the ground of a whole block may be off, between the places whose joint covariance is known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from geomosaic.adjustment.ground_places import GroundPlaces
from geomosaic.arrays import Floats


@dataclass(frozen=True)
class BlockErrors:
    """Errors of a block's ground, interpolated between `GroundPlaces` by thin-plate splines.

    The splines (Duchon 1977) pass through the places' errors, bend least between them and go on linearly
    beyond. So a shift, turn, scale or tilt of the block comes out exactly, everywhere.
    """

    places: GroundPlaces

    def covariances_at(self, at_m: Floats) -> Floats:
        """Covariances (n, 3, 3) in m² of east, north and up of the ground at places (n, 2 or 3)."""
        weight, count = self.weights_at(at_m), len(self.places.places_m)
        joint = self.places.covariance_m2.reshape(count, 3, count, 3)
        out = np.empty((len(weight), 3, 3))
        for a in range(3):
            for b in range(a + 1):
                out[:, a, b] = out[:, b, a] = np.einsum("nk,nk->n", weight @ joint[:, a, :, b], weight)
        return out

    def weights_at(self, at_m: Floats) -> Floats:
        """Shares (n, k) of the places' errors in those at places (n, 2 or 3)."""
        return np.asarray(self._terms(self._scaled(at_m)) @ self._solved)

    @cached_property
    def _solved(self) -> Floats:
        """Coefficients (k + 3, k) of a spline's terms by its values; of places in one line the least ones."""
        at = self._scaled(self.places.places_m)
        terms, count = self._terms(at), len(at)
        whole = np.zeros((count + 3, count + 3))
        whole[:count], whole[count:, :count] = terms, terms[:, count:].T
        return np.asarray(np.linalg.pinv(whole, rcond=1e-12)[:, :count])

    def _terms(self, at: Floats) -> Floats:
        """r² log r of each place, 1, east and north: (n, k + 3)."""
        apart = at[:, None] - self._scaled(self.places.places_m)
        square = np.square(apart).sum(axis=-1)
        bent = 0.5 * square * np.log(np.maximum(square, 1e-300))
        return np.concatenate([bent, np.ones((len(at), 1)), at], axis=1)

    def _scaled(self, at_m: Floats) -> Floats:
        """East and north about the places' middle, in their largest extent."""
        plan = self.places.places_m[:, :2]
        extent_m = float(np.ptp(plan, axis=0).max()) or 1.0
        return np.asarray((at_m[:, :2] - plan.mean(axis=0)) / extent_m)
