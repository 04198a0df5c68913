"""Points that go their own way while poses and lenses stand: each is a small problem of three unknowns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.problem.bundle_model import Factors, Priors, State
from geomosaic.adjustment.problem.tracks import Tracks, part_of
from geomosaic.adjustment.solver.bundle_equations import (
    BEHIND,
    frame_share,
    has_say,
    image_sd_px,
    observed,
    points_sd,
    share_shown,
)
from geomosaic.adjustment.solver.normal_equations import Reduced
from geomosaic.adjustment.terms.collinearity import project_by_levers
from geomosaic.adjustment.terms.terrain import terrain_rows
from geomosaic.constants import tuned
from geomosaic.estimation.linear import eigen_each
from geomosaic.estimation.robust import INFORMATION, cauchy_cost, student_bend, student_cost, student_weight

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_STAND = tuned(
    0.01,
    "of a point's own deviation",
    "that it may be off from where its images want it; with more, those that wander still move frames",
)
_MOST = tuned(
    0.03,
    "share of the points",
    "that are settled by themselves, those that are farthest off: where all are on their way, the step "
    "of the whole block moves them",
)
_FEWEST = tuned(
    3000,
    "points",
    "of a block, below which a step of all of it costs less than some points' own",
)
_ROUNDS = tuned(8, "rounds", "of Newton's steps; a point that crosses to another place takes ten")
_LEAST_BEND = tuned(
    1e-3,
    "share of the largest",
    "of a cost's curvatures, which stands for one that is next to none: a step along it would have no end",
)
_LESS = tuned(0.3, "of a step", "that is tried, point by point, after one that raised its cost")


def wandering(reduced: Reduced) -> Ints:
    """Points that were farthest from where their images want them when these equations were made."""
    side = reduced.normals.point_side
    if len(side) < _FEWEST:
        return np.zeros(0, dtype=np.intp)
    off = np.einsum("pi,pij,pj->p", side, reduced.points_inverse, side)
    farthest = np.argpartition(off, -int(_MOST * len(off)))[-int(_MOST * len(off)) :]
    return np.sort(farthest[off[farthest] > _STAND**2])


def settled_points(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors, which: Ints
) -> State:
    """The state with some points where their images want them, by Newton's steps of each alone.

    One image that is far off makes its point go by a tenth a step for dozens of steps, since weights that are
    right where it stands are wrong where it goes; a few of such among thousands that stand keep a whole block
    from its end. Curvatures count by their size (Dauphin et al. 2014, section 5), so that a point leaves a
    saddle between images that contradict each other.
    """
    if not len(which):
        return state
    own = _Own(tracks, camera_of, priors, state, factors, which)
    here, share = state.points[which], np.ones(len(which))
    cost, side, bend = own.at(here)
    for _ in range(_ROUNDS):
        of, axes = eigen_each(bend)
        of = np.abs(of)
        of = np.maximum(of, _LEAST_BEND * of.max(axis=1, keepdims=True))
        along = np.einsum("pji,pj->pi", axes, side)
        step = share[:, None] * np.einsum("pij,pj->pi", axes, along / of)
        going = (along**2 / of).sum(axis=1) > _STAND**2
        trial = np.where(going[:, None], here + step, here)
        its_cost, its_side, its_bend = own.at(trial)
        good = going & (its_cost < cost)
        here[good], cost[good], side[good], bend[good] = (
            a[good] for a in (trial, its_cost, its_side, its_bend)
        )
        share = np.where(good, 1.0, _LESS * share)
        if not (going & (share > _LESS**3)).any():
            break
    points = state.points.copy()
    points[which] = here
    return replace(state, points=points)


class _Own:
    """Some points' own share of the cost."""

    def __init__(
        self, tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors, which: Ints
    ) -> None:
        number = np.full(len(state.points), -1, dtype=np.intp)
        number[which] = np.arange(len(which))
        self._tracks = some = part_of(tracks, np.flatnonzero(number[tracks.point] >= 0))
        self._which, self._of = which, number[some.point]
        self._camera_of, self._priors, self._state = camera_of, priors, state
        self._shown, self._says = share_shown(some, priors), has_say(some, priors)
        self._sd_px = image_sd_px(some, priors, factors)
        self._given_m, self._weight = priors.points_m[which], 1.0 / points_sd(priors, factors)[which] ** 2
        if priors.terrain is not None:
            height_m = priors.terrain.height_m(state.positions, frame_share(tracks, state), state.level)
            self._ground_sd_m = priors.terrain.sd_share * height_m

    def at(self, points_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Cost (n,); half of its slopes down (n, 3) and curvatures (n, 3, 3), the ground's as expected."""
        points = self._state.points.copy()
        points[self._which] = points_m
        seen = observed(self._tracks, self._camera_of, self._priors, replace(self._state, points=points))
        image, _, _, by_point = project_by_levers(*seen)
        residual = self._tracks.image_px.T - image
        before = np.isfinite(residual).all(axis=0)
        length = np.where(before, np.hypot(*residual), 0.0)
        standard = np.where(before, length / (self._sd_px * np.sqrt(self._shown)), BEHIND)
        weight = np.where(self._says, student_weight(standard) / self._sd_px**2 / INFORMATION, 0.0)
        residual, by_point = (np.where(before, a, 0.0) for a in (residual, by_point))
        along = np.einsum("am,aim->im", residual / np.maximum(length, 1e-12), by_point)
        weighted = weight * by_point
        bend = np.einsum("aim,ajm->ijm", weighted, by_point)
        bend -= (weight * student_bend(standard) * along)[:, None] * along
        each = self._says * self._shown * student_cost(standard)
        rows = (each, *np.einsum("aim,am->im", weighted, residual), *bend.reshape(9, -1))
        sums: Floats = np.stack([np.bincount(self._of, row, len(self._which)) for row in rows], axis=1)
        off_m = self._given_m - points_m
        cost = sums[:, 0] + (self._weight * off_m**2).sum(axis=1)
        sides: Floats = sums[:, 1:4] + self._weight * off_m
        bends: Floats = sums[:, 4:].reshape(-1, 3, 3)
        bends[:, [0, 1, 2], [0, 1, 2]] += self._weight
        if self._priors.terrain is not None:
            bound, level_m = ~self._priors.control[self._which], self._state.level
            rows = terrain_rows(self._priors.terrain, bound, points_m, self._ground_sd_m, level_m)
            held, miss, normal = rows
            cost = cost + bound * cauchy_cost(miss / self._ground_sd_m)
            sides += (held * miss)[:, None] * normal
            bends = bends + held[:, None, None] * normal[:, :, None] * normal[:, None, :]
        return cost, sides, bends
