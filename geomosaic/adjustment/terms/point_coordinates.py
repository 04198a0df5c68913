"""Coordinates of the ground points: surveyed ones of control points, a weak prior of tie points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, Self

import numpy as np
from scipy.optimize import brentq

from geomosaic.adjustment.kernels.collinearity import project_by_levers
from geomosaic.adjustment.kernels.normal_equations import Normals
from geomosaic.adjustment.model import GroundControl
from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.terms.frame_components import common_similarity, common_slope, robust_fit
from geomosaic.adjustment.terms.image_observations import ImageObservations
from geomosaic.adjustment.terms.term import MEASURED_SD_PX, Components, Term
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import MEDIAN_LENGTH, MEDIAN_ONE, ROUNDS
from geomosaic.estimation.linear import inverse_each, paraboloid_design
from geomosaic.estimation.robust import (
    LEAST_OBSERVATIONS,
    credible,
    median_of_known,
    redescending_weight,
    student_weight,
)
from geomosaic.survey.accuracy import POSITION

CONTROL_PLAN, CONTROL_HEIGHT = "control plan", "control height"


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


@dataclass(frozen=True)
class ControlResiduals:
    """Surveyed minus intersected coordinates of n control points. point (n,): numbers among all points. off_m
    (n, 3): without the part that all have in common. own_sd_m (n, 3): of the intersections. common: how many
    numbers that part has in plan and in height. image_px: deviation of the image coordinates, by their
    residuals at the intersections."""

    point: Ints
    off_m: Floats
    own_sd_m: Floats
    common: tuple[float, float]
    image_px: float


def control_factors(components: Components) -> Floats:
    """Factors of the stated deviations east, north and up, (3,)."""
    plan = components[CONTROL_PLAN]
    return np.array([plan, plan, components[CONTROL_HEIGHT]])


def control_components(residuals: ControlResiduals, sd_m: Floats, most_px: float) -> dict[str, float]:
    """Factors of the stated deviations sd_m (p, 3) in plan and in height, at least 1, and the deviation of
    the image coordinates. What all points have in common (a similarity; a height that may slope and bend)
    does not count: it may be the block's."""
    stated = sd_m[residuals.point]
    plan = _factor(residuals.off_m[:, :2], stated[:, :2], residuals.own_sd_m[:, :2], residuals.common[0])
    known, height = _height_known(stated), 1.0
    if known.sum() >= LEAST_OBSERVATIONS:
        off, own = residuals.off_m[known, 2:], residuals.own_sd_m[known, 2:]
        height = _factor(off, stated[known, 2:], own, residuals.common[1])
    return {"control image": min(residuals.image_px, most_px), CONTROL_PLAN: plan, CONTROL_HEIGHT: height}


def control_weights(residuals: ControlResiduals, sd_m: Floats, components: Components) -> Floats:
    """Weights of the points' coordinates, (p, 3), below 1 for points that contradict the others."""
    out = np.ones_like(sd_m)
    sd = np.hypot(sd_m[residuals.point] * control_factors(components), residuals.own_sd_m)
    for columns in ([0, 1], [2]):
        length = np.linalg.norm(residuals.off_m[:, columns] / sd[:, columns], axis=1)
        typical = MEDIAN_LENGTH if len(columns) == 2 else MEDIAN_ONE
        bulk = max(1.0, float(np.median(length)) / typical)
        out[residuals.point[:, None], columns] = redescending_weight(length / bulk)[:, None]
    return out


def with_precision(control: Sequence[GroundControl], components: Components) -> tuple[GroundControl, ...]:
    """Control and check points with the estimated precision: they were measured alike."""
    return tuple(replace(c, sd_m=c.sd_m * control_factors(components)) for c in control)


def precision_figures(control: Sequence[GroundControl], components: Components) -> dict[str, float]:
    """Median deviations of the points that took part, in m; nothing where they were too few to tell."""
    used = np.array([c.sd_m for c in control if not c.check and c.observations]).reshape(-1, 3)
    if len(used) < LEAST_OBSERVATIONS:
        return {}
    found = {"control_sd_m.plan": components[CONTROL_PLAN] * float(np.median(used[:, 0]))}
    known = _height_known(used)
    if known.any():
        found["control_sd_m.height"] = components[CONTROL_HEIGHT] * float(np.median(used[known, 2]))
    return found


def _height_known(sd_m: Floats) -> Bools:
    return np.asarray(sd_m[:, 2] < POSITION["none"].sd_vertical_m)


def intersection_residuals(
    image: ImageObservations, surveyed: PointCoordinates, at: Estimate
) -> ControlResiduals | None:
    """Of control points intersected by the present poses from two frames or more; None for too few."""
    some = image.of(np.flatnonzero(image.by_hand & image.used))
    if len(np.unique(some.tracks.point)) < LEAST_OBSERVATIONS:
        return None
    point, of = np.unique(some.tracks.point, return_inverse=True)
    points, scale_px = at.points_m.copy(), np.inf
    for _ in range(ROUNDS):
        here = replace(at, points_m=points)
        rows = some.projections_in_own_rows(here, some.computed_px(here))
        computed, _, _, by_point = project_by_levers(rows)
        residual = some.tracks.image_px.T - computed
        length = np.hypot(*residual)
        weight = np.where(np.isfinite(length), student_weight(length / scale_px), 0.0)
        residual, by_point = (np.where(np.isfinite(length), a, 0.0) for a in (residual, by_point))
        scale_px = max(MEASURED_SD_PX, median_of_known(length) / MEDIAN_LENGTH)
        normal, side = np.zeros((len(point), 3, 3)), np.zeros((len(point), 3))
        np.add.at(normal, of, np.einsum("m,aim,ajm->mij", weight, by_point, by_point))
        np.add.at(side, of, np.einsum("m,aim,am->mi", weight, by_point, residual))
        cofactors = inverse_each(normal)
        step = np.einsum("pij,pj->pi", cofactors, side)
        points = points.copy()
        points[point] += np.where(np.isfinite(step), step, 0.0)
    variances = np.diagonal(cofactors, axis1=1, axis2=2)
    own_sd_m = scale_px * np.sqrt(np.where(variances > 0.0, variances, np.nan))
    frames = np.zeros(len(point), dtype=np.intp)
    np.add.at(frames, np.unique(np.column_stack([of, some.tracks.frame]), axis=0)[:, 0], 1)
    good = np.isfinite(own_sd_m).all(axis=1) & np.isfinite(points[point]).all(axis=1) & (frames > 1)
    if good.sum() < LEAST_OBSERVATIONS:
        return None
    point, own_sd_m = point[good], own_sd_m[good]
    at_m = points[point]
    off_m, common_up = _without_common(surveyed, point, at_m, own_sd_m)
    return ControlResiduals(point, off_m, own_sd_m, (4.0, common_up), scale_px)


def _without_common(
    surveyed: PointCoordinates, point: Ints, at_m: Floats, own_sd_m: Floats
) -> tuple[Floats, float]:
    """Surveyed minus intersected (n, 3) without what all points have in common, and how many numbers that has
    in height. Unknown heights count as 0."""
    off_m = surveyed.given_m[point] - at_m
    sd_m = np.hypot(surveyed.sd_m[point], own_sd_m)
    off_m[:, :2] -= common_similarity(at_m[:, :2], off_m[:, :2], sd_m[:, :2])
    known, common_up = _height_known(surveyed.sd_m[point]), 0.0
    if known.any():
        slope = common_slope(at_m[known, :2], off_m[known, 2], sd_m[known, 2], surveyed.tilt_sd_rad)
        off_m[known, 2] -= slope
        common_up = 3.0 if np.ptp(slope) > 0.0 else 1.0
        bend = _bend(at_m[known, :2], off_m[known, 2], sd_m[known, 2])
        if bend is not None:
            off_m[known, 2] -= bend
            common_up = 6.0  # level, slope, bend
    off_m[~known, 2] = 0.0
    return off_m, common_up


def _bend(at_m: Floats, miss_m: Floats, sd_m: Floats) -> Floats | None:
    """The polynomial of the second degree that residuals in height (k,) have in common, as a bent block
    leaves at precise points. None with fewer than two points more than its numbers, or where the bend may be
    chance (Schwarz 1978)."""
    design = paraboloid_design(at_m)
    if len(design) < design.shape[1] + 2:
        return None
    fitted, _, weight = robust_fit(design[:, None], miss_m[:, None], sd_m[:, None])
    found = fitted[:, 0]
    squares = [float(weight[:, 0] @ its**2) for its in (miss_m, miss_m - found)]
    gain = len(design) * np.log(max(squares[0], 1e-300) / max(squares[1], 1e-300))
    return np.asarray(found) if gain > 3.0 * np.log(len(design)) else None


def _root(excess: Callable[[float], float]) -> float:
    """The factor, at least 1, at which something that falls with it comes down to 1."""
    if not excess(1.0) > 1.0:
        return 1.0
    most = 1.0
    while excess(float(np.exp(most))) > 1.0:  # it falls to 0
        most *= 2.0
    return float(np.exp(brentq(lambda log: excess(float(np.exp(log))) - 1.0, 0.0, most)))


def _factor(off_m: Floats, stated_m: Floats, own_m: Floats, common: float) -> float:
    """What stated deviations (n, c) are to be multiplied with, at least 1, so that residuals scatter as
    stated; shrunk to 1 where that may be chance. Robust: begun from the median, points beyond three
    deviations lose their weight."""
    c = off_m.shape[1]
    typical = MEDIAN_LENGTH if c == 2 else MEDIAN_ONE
    lost = np.sqrt(off_m.size / max(off_m.size - common, 1.0))

    def lengths(factor: float) -> Floats:
        return np.asarray(np.linalg.norm(off_m / np.hypot(factor * stated_m, own_m), axis=1))

    def scatter(factor: float, weight: Floats, redundancy: float) -> float:
        return float(np.sqrt((weight * lengths(factor) ** 2).sum() / redundancy))

    factor = _root(lambda f: lost * float(np.median(lengths(f))) / typical)
    weight, redundancy = np.ones(len(off_m)), 1.0
    for _ in range(ROUNDS):
        weight = redescending_weight(lengths(factor))
        redundancy = max(float(c * weight.sum()) - common, 1.0)
        factor = _root(partial(scatter, weight=weight, redundancy=redundancy))
    as_stated = scatter(1.0, weight, redundancy)
    if factor <= 1.0 or as_stated <= 1.0:
        return 1.0
    sure = np.log(credible(as_stated, redundancy)) / np.log(as_stated)
    return float(factor ** np.clip(sure, 0.0, 1.0))
