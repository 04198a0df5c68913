"""How precise ground control is: a variance component, and the say of each point."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import GroundControl
from geomosaic.adjustment.problem.bundle_model import MEASURED_SD_PX, Factors, Priors, State
from geomosaic.adjustment.problem.tracks import Tracks, part_of
from geomosaic.adjustment.solver.bundle_equations import has_say, in_own_rows, longest_side_px, seen_px
from geomosaic.adjustment.solver.prior_reweighting import (
    MEDIAN_ONE,
    common_similarity,
    common_slope,
    median_px,
)
from geomosaic.adjustment.terms.collinearity import project_by_levers
from geomosaic.constants import MEDIAN_LENGTH, sourced, tuned
from geomosaic.estimation.linear import inverse_each, least_squares
from geomosaic.estimation.robust import credible, lie_weight, student_weight
from geomosaic.survey.accuracy import POSITION
from geomosaic.survey.model import Warn

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
LEAST_POINTS = sourced(
    5,
    "points",
    "of which the precision is estimated: of fewer, what a similarity leaves is chance",
    "10 coordinates in plan less the 4 of a similarity",
)
_COARSER = sourced(
    1.5,
    "times the stated deviation",
    "from which a warning says so: F test at 1 % of 16 coordinates less 4 against none",
    "chi-squared distribution: 26.2 of 12 degrees of freedom, root of the ratio 1.48",
)
_BEND = sourced(6, "numbers", "of a polynomial of the second degree: level, slope, bend", "by its definition")
_ROUNDS = tuned(12, "rounds", "of re-weighting, which then stands to a hundredth")


@dataclass(frozen=True)
class _Misses:
    """What control points miss: surveyed minus where their images put them.

    point (n,): numbers among the priors' points. off_m (n, 3): less what all miss in common. own_sd_m (n, 3):
    of the intersections. common (3,): how many numbers of east and north, twice, and up were taken off.
    image_px: median miss of the image coordinates at the intersections, as a deviation.
    """

    point: Ints
    off_m: Floats
    own_sd_m: Floats
    common: tuple[float, float]
    image_px: float


def control_component(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors
) -> Factors:
    """The factors with those of control: what its coordinates' stated deviations are multiplied with, in plan
    and in height, at least 1, and the deviation of its image coordinates.

    Where fewer than five points are seen in two frames, the stated deviations stand, and the image
    coordinates count by their median miss. What all points miss in common (a shift, turn and scale; a height
    that may slope and bend) says nothing of their precision: a block that does not yet lie on control would
    widen it.
    """
    misses = _misses(tracks, camera_of, priors, state)
    if misses is None:
        return factors
    stated = priors.points_sd_m[misses.point]
    plan = _factor(misses.off_m[:, :2], stated[:, :2], misses.own_sd_m[:, :2], misses.common[0])
    known = _height_known(stated)
    height = 1.0
    if known.sum() >= LEAST_POINTS:
        height = _factor(
            misses.off_m[known, 2:], stated[known, 2:], misses.own_sd_m[known, 2:], misses.common[1]
        )
    control_px = min(misses.image_px, longest_side_px(priors))
    return replace(factors, control_px=control_px, control_plan=plan, control_height=height)


def control_say(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors
) -> Floats | None:
    """Factors of the weights (p, 3) of the points' coordinates, below 1 for control that contradicts the rest
    of control; None where too few points show that."""
    misses = _misses(tracks, camera_of, priors, state)
    if misses is None:
        return None
    out = np.ones_like(priors.points_m)
    sd = np.hypot(priors.points_sd_m[misses.point] * factors.of_control, misses.own_sd_m)
    for columns in ([0, 1], [2]):
        length = np.linalg.norm(misses.off_m[:, columns] / sd[:, columns], axis=1)
        typical = MEDIAN_LENGTH if len(columns) == 2 else MEDIAN_ONE
        bulk = max(1.0, float(np.median(length)) / typical)
        out[misses.point[:, None], columns] = lie_weight(length / bulk)[:, None]
    return out


def with_precision(control: Sequence[GroundControl], factors: Factors) -> tuple[GroundControl, ...]:
    """Control and check points with the estimated precision: they were measured alike."""
    return tuple(replace(c, sd_m=c.sd_m * factors.of_control) for c in control)


def precision_figures(control: Sequence[GroundControl], factors: Factors) -> dict[str, float]:
    """Median deviations of the points that took part, in m; nothing where they were too few to tell."""
    used = np.array([c.sd_m for c in control if not c.check and c.observations]).reshape(-1, 3)
    if len(used) < LEAST_POINTS:
        return {}
    found = {"control_sd_m.plan": factors.control_plan * float(np.median(used[:, 0]))}
    known = _height_known(used)
    if known.any():
        found["control_sd_m.height"] = factors.control_height * float(np.median(used[known, 2]))
    return found


def precision_warnings(control: Sequence[GroundControl], factors: Factors) -> list[Warn]:
    """One line where control is less precise than stated."""
    stated = precision_figures(control, Factors())
    found = precision_figures(control, factors)
    words = [
        f"{found[name]:.2g} m in {name.rpartition('.')[2]} (stated {stated[name]:.2g} m)"
        for name in found
        if found[name] > _COARSER * stated[name]
    ]
    if not words:
        return []
    text = (
        f"control points agree to {' and '.join(words)}: weighted by that; the map lies no surer than they do"
    )
    return [Warn("control-imprecise", "", text)]


def _height_known(sd_m: Floats) -> NDArray[np.bool_]:
    return np.asarray(sd_m[:, 2] < POSITION["none"].sd_vertical_m)


def _misses(tracks: Tracks, camera_of: Ints, priors: Priors, state: State) -> _Misses | None:
    """None where fewer than LEAST_POINTS control points can be intersected."""
    which = np.flatnonzero(priors.control[tracks.point] & has_say(tracks, priors))
    if len(np.unique(tracks.point[which])) < LEAST_POINTS:
        return None
    some = part_of(tracks, which)
    point, of = np.unique(some.point, return_inverse=True)
    points, scale_px = state.points.copy(), np.inf
    for _ in range(_ROUNDS):
        here = replace(state, points=points)
        rows = in_own_rows(some, camera_of, priors, here, seen_px(some, camera_of, priors, here))
        image, _, _, by_point = project_by_levers(*rows)
        residual = some.image_px.T - image
        length = np.hypot(*residual)
        weight = np.where(np.isfinite(length), student_weight(length / scale_px), 0.0)
        residual, by_point = (np.where(np.isfinite(length), a, 0.0) for a in (residual, by_point))
        scale_px = max(MEASURED_SD_PX, median_px(length) / MEDIAN_LENGTH)
        normal, side = np.zeros((len(point), 3, 3)), np.zeros((len(point), 3))
        np.add.at(normal, of, np.einsum("m,aim,ajm->mij", weight, by_point, by_point))
        np.add.at(side, of, np.einsum("m,aim,am->mi", weight, by_point, residual))
        cofactors = inverse_each(normal)
        step = np.einsum("pij,pj->pi", cofactors, side)
        points[point] += np.where(np.isfinite(step), step, 0.0)
    variances = np.diagonal(cofactors, axis1=1, axis2=2)
    own_sd_m = scale_px * np.sqrt(np.where(variances > 0.0, variances, np.nan))
    frames = np.zeros(len(point), dtype=np.intp)
    np.add.at(frames, np.unique(np.column_stack([of, some.frame]), axis=0)[:, 0], 1)
    good = np.isfinite(own_sd_m).all(axis=1) & np.isfinite(points[point]).all(axis=1) & (frames > 1)
    if good.sum() < LEAST_POINTS:
        return None
    point, own_sd_m = point[good], own_sd_m[good]
    at_m = points[point]
    off_m = priors.points_m[point] - at_m
    sd_m = np.hypot(priors.points_sd_m[point], own_sd_m)
    off_m[:, :2] -= common_similarity(at_m[:, :2], off_m[:, :2], sd_m[:, :2])
    known = _height_known(priors.points_sd_m[point])
    common_up = 0.0
    if known.any():
        may_rad = float(np.median(priors.poses.rotations_sd_rad[:, :2]))
        slope = common_slope(at_m[known, :2], off_m[known, 2], sd_m[known, 2], may_rad)
        off_m[known, 2] -= slope
        common_up = 3.0 if np.ptp(slope) > 0.0 else 1.0
        bend = _bend(at_m[known, :2], off_m[known, 2], sd_m[known, 2])
        if bend is not None:
            off_m[known, 2] -= bend
            common_up = float(_BEND)
    off_m[~known, 2] = 0.0
    return _Misses(point, off_m, own_sd_m, (4.0, common_up), scale_px)


def _bend(at_m: Floats, miss_m: Floats, sd_m: Floats) -> Floats | None:
    """The polynomial of the second degree in what height misses (k,) have in common, which a bent block
    leaves at precise points; None where fewer than two points more than its numbers are there, or where it
    explains no more than its numbers would by chance (Schwarz 1978)."""
    if len(at_m) < _BEND + 2:
        return None
    x, y = ((at_m - at_m.mean(axis=0)) / max(float(np.ptp(at_m, axis=0).max()), 1e-9)).T
    design = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
    found = np.zeros(len(x))
    weight = 1.0 / sd_m
    for _ in range(_ROUNDS):
        found = design @ least_squares(design * weight[:, None], miss_m * weight, rcond=1e-6)
        length = np.abs(miss_m - found) / sd_m
        weight = np.sqrt(lie_weight(length / max(float(np.median(length)) / MEDIAN_ONE, 1e-9))) / sd_m
    squares = [float(((its * weight) ** 2).sum()) for its in (miss_m, miss_m - found)]
    gain = len(x) * np.log(max(squares[0], 1e-300) / max(squares[1], 1e-300))
    return np.asarray(found) if gain > 3.0 * np.log(len(x)) else None


def _root(excess: Callable[[float], float]) -> float:
    """The factor, at least 1, at which something that falls with it comes down to 1, by bisection."""
    if not excess(1.0) > 1.0:
        return 1.0
    low, high = 0.0, 20.0
    for _ in range(50):
        middle = (low + high) / 2.0
        low, high = (middle, high) if excess(float(np.exp(middle))) > 1.0 else (low, middle)
    return float(np.exp(low))


def _factor(off_m: Floats, stated_m: Floats, own_m: Floats, common: float) -> float:
    """What stated deviations (n, c) are to be multiplied with, at least 1, so that misses scatter as stated;
    drawn to 1 where that may be chance.

    Robust: begun from the median, points beyond three deviations lose their weight.
    """
    c = off_m.shape[1]
    typical = MEDIAN_LENGTH if c == 2 else MEDIAN_ONE
    lost = np.sqrt(off_m.size / max(off_m.size - common, 1.0))

    def lengths(factor: float) -> Floats:
        return np.asarray(np.linalg.norm(off_m / np.hypot(factor * stated_m, own_m), axis=1))

    def scatter(factor: float, weight: Floats, redundancy: float) -> float:
        return float(np.sqrt((weight * lengths(factor) ** 2).sum() / redundancy))

    factor = _root(lambda f: lost * float(np.median(lengths(f))) / typical)
    weight, redundancy = np.ones(len(off_m)), 1.0
    for _ in range(_ROUNDS):
        weight = lie_weight(lengths(factor))
        redundancy = max(float(c * weight.sum()) - common, 1.0)
        factor = _root(partial(scatter, weight=weight, redundancy=redundancy))
    as_stated = scatter(1.0, weight, redundancy)
    if factor <= 1.0 or as_stated <= 1.0:
        return 1.0
    sure = np.log(credible(as_stated, redundancy)) / np.log(as_stated)
    return float(factor ** np.clip(sure, 0.0, 1.0))
