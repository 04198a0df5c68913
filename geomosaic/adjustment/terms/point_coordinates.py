"""Coordinates of the ground points: surveyed ones of control points, a weak prior of tie points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from geomosaic.adjustment.kernels.normal_equations import Normals
from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.terms.control_precision import (
    CONTROL_HEIGHT,
    CONTROL_PLAN,
    control_factors,
    control_weights,
    intersection_residuals,
)
from geomosaic.adjustment.terms.image_observations import ImageObservations
from geomosaic.adjustment.terms.term import Components, Term
from geomosaic.arrays import Bools, Floats, Ints


@dataclass(frozen=True)
class PointCoordinates(Term):
    """Prior coordinates of p points, with weights (p, 3) between 0 and 1. given_m, sd_m (p, 3): surveyed
    coordinates of control points; of tie points the ground below them, weakly. control (p,): which points are
    control. tilt_sd_rad: the steepest common slope of control heights against the block."""

    given_m: Floats
    sd_m: Floats
    control: Bools
    weight: Floats
    tilt_sd_rad: float

    name: ClassVar[str] = "point coordinates"

    def component_names(self) -> tuple[str, ...]:
        return CONTROL_PLAN, CONTROL_HEIGHT

    def of(self, which: Ints) -> Self:
        """Those of some points."""
        arrays = {name: getattr(self, name)[which] for name in ("given_m", "sd_m", "control", "weight")}
        return replace(self, **arrays)

    def present_sd_m(self, components: Components) -> Floats:
        """Deviations with variance component and robust weight, (p, 3)."""
        factor = np.where(self.control[:, None], control_factors(components), 1.0)
        return np.asarray(self.sd_m * factor / np.sqrt(self.weight))

    def cost(self, at: Estimate, components: Components) -> float:
        return float((((self.given_m - at.points_m) / self.present_sd_m(components)) ** 2).sum())

    def add_to(self, normals: Normals, at: Estimate, components: Components) -> Normals:
        information = 1.0 / self.present_sd_m(components) ** 2
        normals.points[:, [0, 1, 2], [0, 1, 2]] += information
        normals.point_side[:] += (self.given_m - at.points_m) * information
        return normals

    def reweighted(self, image: ImageObservations, at: Estimate, components: Components) -> Self:
        residuals = intersection_residuals(image, self, at)
        if residuals is None:
            return replace(self, weight=np.ones_like(self.sd_m))
        return replace(self, weight=control_weights(residuals, self.sd_m, components))
