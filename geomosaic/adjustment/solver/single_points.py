"""Points that move by themselves while poses and lenses stay, and how near they may come to cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.kernels.collinearity import project_by_levers
from geomosaic.adjustment.kernels.observation_groups import AT_ONCE
from geomosaic.adjustment.kernels.reduced_equations import Reduced
from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.terms.image_observations import BEHIND
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import tuned
from geomosaic.estimation.linear import eigen_each, inverse_roots
from geomosaic.estimation.robust import INFORMATION, student_bend, student_cost, student_weight
from geomosaic.matching.tracks import Tracks, frame_by_frame

_NEAREST = tuned(0.05, "share of a frame's usual distance to its points", "more: tall trees are pulled down")
_FEWEST = tuned(1000, "points", "fewer: a step of the whole block costs less than some points' own")
_ROUNDS = tuned(8, "rounds", "of Newton's steps; a point that crosses to another place takes ten")
_LEAST_BEND = tuned(1e-3, "share of the largest curvature", "less: a step along it has no end")
_LESS = tuned(0.3, "of a step", "tried, point by point, after one that raised its cost")


def clearances_m(tracks: Tracks, positions_m: Floats, points_m: Floats) -> Floats:
    """The least distance of each frame's points, (f,), by where they are; 0 for a frame that sees none."""
    out = np.zeros(len(positions_m))
    for i, mine in frame_by_frame(tracks.frame):
        away = points_m[tracks.point[mine]] - positions_m[i]
        out[i] = _NEAREST * float(np.median(np.linalg.norm(away, axis=1)))
    return out


def too_near(tracks: Tracks, clearance_m: Floats, positions_m: Floats, points_m: Floats) -> Ints:
    """Points that lie nearer to a camera that sees them."""
    square_m2, near = np.zeros(len(tracks.frame)), np.square(clearance_m)[tracks.frame]
    for points, positions in zip(points_m.T, positions_m.T, strict=True):
        square_m2 += np.square(points[tracks.point] - positions[tracks.frame])
    return np.unique(tracks.point[square_m2 < near])


def wandering(reduced: Reduced, stand: float) -> Ints:
    """Points that were off their minimum by more than `stand` deviations when these equations were made."""
    side = reduced.normals.point_side
    if len(side) < _FEWEST:
        return np.zeros(0, dtype=np.intp)
    off = np.einsum("pi,pij,pj->p", side, reduced.points_inverse, side)
    return np.flatnonzero(off > stand**2)


def converged_points(
    problem: BlockProblem, at: Estimate, components: Components, which: Ints, stand: float
) -> Estimate:
    """The estimate with some points brought within `stand` deviations of their minimum, by Newton's steps of
    each. One image that is far off moves its point by a tenth a step, and keeps a block of thousands from
    converging. Curvatures count by their size (Dauphin et al. 2014, section 5), so that a point leaves a
    saddle between images that contradict each other."""
    if not len(which):
        return at
    points_m, wanted = at.points_m.copy(), np.zeros(len(at.points_m), dtype=bool)
    wanted[which] = True
    seen = np.flatnonzero(wanted[problem.tracks.point])
    ends = np.append(0, np.searchsorted(problem.tracks.point[seen], which, side="right"))
    cuts = np.unique(np.searchsorted(ends, np.arange(AT_ONCE, len(seen), AT_ONCE)))
    cuts = cuts[cuts < len(which)]
    for some, its in zip(np.split(which, cuts), np.split(seen, ends[cuts]), strict=True):
        points_m[some] = _converged(_Own(problem, at, components, some, its), points_m[some], stand)
    return replace(at, points_m=points_m)


def _converged(own: _Own, begun_m: Floats, stand: float) -> Floats:
    """Where some points (n, 3) come to."""
    points = here = begun_m
    place, share = np.arange(len(here)), np.ones(len(here))
    cost, side, bend = own.at(here)
    for _ in range(_ROUNDS):
        step, gain = _newton_step(side, bend)
        going = gain > stand**2
        points[place[~going]] = here[~going]
        own = own.of(going)
        place = place[going]
        here, share, cost, side, bend = (a[going] for a in (here, share, cost, side, bend))
        if not len(here):
            break
        there = here + share[:, None] * step[going]
        its_cost, its_side, its_bend = own.at(there)
        good = its_cost < cost
        for kept, trial in ((here, there), (cost, its_cost), (side, its_side), (bend, its_bend)):
            kept[good] = trial[good]
        share = np.where(good, 1.0, _LESS * share)
    points[place] = here
    return points


def _newton_step(side: Floats, bend: Floats) -> tuple[Floats, Floats]:
    """Newton's step of each point (n, 3), and what it is expected to gain (n,), in squared deviations."""
    root = inverse_roots(bend)
    along = np.einsum("pij,pj->pi", root, side)
    step, gain = np.einsum("pji,pj->pi", root, along), (along**2).sum(axis=1)
    spread = np.trace(bend, axis1=1, axis2=2) * (root**2).sum(axis=(1, 2))
    odd = np.flatnonzero(~((spread > 0.0) & (spread < 1.0 / _LEAST_BEND)))
    if len(odd):
        of, axes = eigen_each(bend[odd])
        of = np.abs(of)
        of = np.maximum(of, _LEAST_BEND * of.max(axis=1, keepdims=True))
        along = np.einsum("pji,pj->pi", axes, side[odd])
        step[odd], gain[odd] = np.einsum("pij,pj->pi", axes, along / of), (along**2 / of).sum(axis=1)
    return step, gain


class _Own:
    """Some points' own share of the cost; which (n,): their numbers, rising; seen (m,): their
    observations."""

    def __init__(
        self, problem: BlockProblem, at: Estimate, components: Components, which: Ints, seen: Ints
    ) -> None:
        self._which, self._problem, self._at, self._components = which, problem, at, components
        self._all, self._image = seen, problem.image.of(seen)
        self._of = np.searchsorted(which, self._image.tracks.point)
        self._seen = self._image.projections(at)
        self._shown, self._used = problem.image.shown[seen], self._image.used
        self._sd_px, self._as_many = self._image.sd_px(components), self._image.as_many
        points = problem.points.of(which)
        self._given_m, self._weight = points.given_m, 1.0 / points.present_sd_m(components) ** 2
        self._terrain = problem.terrain
        if self._terrain is not None:
            self._ground_sd_m, self._bound = self._terrain.sd_m(at), self._terrain.bound[which]

    def of(self, kept: Bools) -> _Own:
        """Of some of these points."""
        if kept.all():
            return self
        seen = self._all[kept[self._of]]
        return _Own(self._problem, self._at, self._components, self._which[kept], seen)

    def at(self, points_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Cost (n,); half of its slopes down (n, 3) and curvatures (n, 3, 3), the ground's as expected."""
        computed, _, _, by_point = project_by_levers(replace(self._seen, points_m=points_m[self._of]))
        residual = self._image.tracks.image_px.T - computed
        before = np.isfinite(residual).all(axis=0)
        length = np.where(before, np.hypot(*residual), 0.0)
        standard = np.where(before, length / (self._sd_px * np.sqrt(self._shown)), BEHIND)
        counts = self._used / self._as_many
        weight = counts * student_weight(standard) / self._sd_px**2 / INFORMATION
        residual, by_point = (np.where(before, a, 0.0) for a in (residual, by_point))
        along = np.einsum("am,aim->im", residual / np.maximum(length, 1e-12), by_point)
        weighted = weight * by_point
        bend = np.einsum("aim,ajm->ijm", weighted, by_point)
        bend -= (weight * student_bend(standard) * along)[:, None] * along
        each = counts * self._shown * student_cost(standard)
        rows = (each, *np.einsum("aim,am->im", weighted, residual), *bend.reshape(9, -1))
        sums: Floats = np.stack([np.bincount(self._of, row, len(self._which)) for row in rows], axis=1)
        off_m = self._given_m - points_m
        cost = sums[:, 0] + (self._weight * off_m**2).sum(axis=1)
        sides: Floats = sums[:, 1:4] + self._weight * off_m
        bends: Floats = sums[:, 4:].reshape(-1, 3, 3)
        bends[:, [0, 1, 2], [0, 1, 2]] += self._weight
        if self._terrain is not None:
            sd_m, level_m = self._ground_sd_m, self._at.level_m
            pull, miss, normal = self._terrain.rows(points_m, self._bound, sd_m, level_m)
            cost = cost + self._bound * self._terrain.cost_of(points_m, sd_m, level_m)
            sides += (pull * miss)[:, None] * normal
            bends = bends + pull[:, None, None] * normal[:, :, None] * normal[:, None, :]
        return cost, sides, bends
