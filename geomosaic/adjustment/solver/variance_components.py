"""Variance components: what residuals and redundancy show of the stated deviations, also by neighbourhood."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import digamma, polygamma

from geomosaic.adjustment.kernels.reduced_equations import Reduced
from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.terms.image_observations import CONTROL_IMAGE, IMAGE
from geomosaic.adjustment.terms.point_coordinates import (
    CONTROL_HEIGHT,
    CONTROL_PLAN,
    control_components,
    intersection_residuals,
)
from geomosaic.adjustment.terms.term import Component, Components
from geomosaic.adjustment.terms.terrain import surface_share
from geomosaic.arrays import Bools, Floats
from geomosaic.constants import tuned
from geomosaic.estimation.linear import least_squares
from geomosaic.matching.tracks import Tracks

_NEIGHBOURS = tuned(8, "points", "fewer: chance; more: they reach beyond a crown")
_FEWEST = tuned(100, "points", "of a block; fewer: places cannot be distinguished")
EXACT_PX = tuned(1e-4, "px", "of a point's residuals, so that exact ones have a logarithm")
_NOISE = tuned(
    30.0, "median residuals", "of what moves; less: crowns in a storm; more: blunders far off weigh"
)
_TIMES = tuned((0.5, 4.0), "times its own change", "beyond: chance where unknowns are still on their way")


def local_factors(tracks: Tracks, points_m: Floats, length_px: Floats, counts: Bools) -> Floats:
    """Factor of the image deviation about each point, (p,), 1 at the median place.

    The logarithm of each point's variance is averaged over neighbours, weighted by its redundancy. (Bartlett
    and Kendall 1946, The statistical analysis of variance-heterogeneity and the logarithmic transformation.)
    It is shrunk to the median by how much more it scatters than chance explains (Efron and Morris 1975, Data
    analysis using Stein's estimator, section 2). Points that errors fling to one place are no noise of it: no
    residual counts as more than 30 usual ones. Args: points_m (p, 3); length_px, counts (m,): of each
    observation, its residual and whether it counts.
    """
    out = np.ones(len(points_m))
    use = counts & np.isfinite(length_px)
    views = np.bincount(tracks.point[use], minlength=len(out))
    most_px = _NOISE * max(float(np.median(length_px[use])), EXACT_PX) if use.any() else 0.0
    squares = np.bincount(tracks.point[use], np.minimum(length_px[use], most_px) ** 2, minlength=len(out))
    known = np.flatnonzero(views >= 2)
    if len(known) < _FEWEST:
        return out
    freedom = 2.0 * views[known] - 3.0
    found = np.log(np.maximum(squares[known] / freedom, EXACT_PX**2))
    found -= digamma(freedom / 2.0) - np.log(freedom / 2.0)
    weight = 1.0 / polygamma(1, freedom / 2.0)
    near = cKDTree(points_m[known, :2]).query(points_m[known, :2], k=_NEIGHBOURS)[1]
    variance = 1.0 / weight[near].sum(axis=1)
    mean = (weight[near] * found[near]).sum(axis=1) * variance
    differ = max(float(np.var(mean) - variance.mean()), 0.0)
    out[known] = np.exp(0.5 * differ / (differ + variance) * (mean - np.median(mean)))
    return out


def variance_components(
    problem: BlockProblem, at: Estimate, before: Components, reduced: Reduced, *, image_only: bool
) -> tuple[Components, float, float]:
    """The components by residuals and redundancy (Foerstner 1979), and the largest relative changes of those
    of images and control, and of all others. Those of the frames' observations, found by Newton's step, wait
    until the image's has converged (image_only), else they would take up what the poses have not yet reached.
    Residuals that all frames of a part have in common do not count. Args: reduced: the equations of the last
    step, whose redundancies count."""
    computed = _Computed.of(problem, at, reduced)
    determined = surface_share(reduced.normals, reduced.points_inverse)
    for term in problem.frames:
        determined += float((computed.variances(term.columns(at)) * term.information(before)).sum())
    prior = np.diag(computed.shared) / problem.shared_sd(at.layout) ** 2
    determined += float(np.delete(prior, at.layout.level).sum())
    ties = int((~problem.points.control & (problem.image.views > 0)).sum())
    unknowns = reduced.pose_side.size + at.layout.size - 1 + 3 * ties - determined
    image = problem.image
    after = before.also(image.components(at, before, unknowns))
    residuals = intersection_residuals(image, problem.points, at)
    if residuals is not None:
        after = after.also(control_components(residuals, problem.points.sd_m, image.longest_side_px))
    names = IMAGE, CONTROL_IMAGE, CONTROL_PLAN, CONTROL_HEIGHT
    image_change = max(abs(float(np.log(before[name] / after[name]))) for name in names)
    if image_only:
        return after, image_change, 0.0
    each = ((t, t.components(at, after, computed.variances(t.columns(at)))) for t in problem.frames)
    found = [computed.placed(c, term.columns(at)) for term, cs in each for c in cs]
    followed = _followed(problem, at, after, found, computed)
    others, change = _ahead(found, before, followed)
    return after.also(others), image_change, change


def _ahead(found: list[Component], before: Components, followed: Floats) -> tuple[dict[str, float], float]:
    """Where the components will converge to, and the largest relative change on the way there. A component
    estimated again and again goes a part of its way each time, since residuals are smaller the smaller they
    are assumed to be. How far one follows the other is known, so it goes the whole way at once (Newton's
    step)."""
    old = np.log([before[c.name] for c in found])
    change = np.log([c.factor for c in found]) - old
    if not change.any():
        return {c.name: c.factor for c in found}, 0.0
    whole = least_squares(np.eye(len(change)) - followed, change)
    times = np.divide(whole, change, out=np.ones_like(change), where=change != 0.0)
    logs = old + change * np.clip(times, *_TIMES)
    sent = np.clip(np.exp(logs), [c.least for c in found], [c.most for c in found])
    values = {c.name: float(v) for c, v in zip(found, sent, strict=True)}
    return values, float(np.abs(np.log(sent) - old).max())


def _followed(
    problem: BlockProblem, at: Estimate, components: Components, found: list[Component], computed: _Computed
) -> Floats:
    """By how much the logarithm of each estimated component follows that of each assumed one, (g, g). Another
    deviation moves the unknowns and with them the squares of all; redundancies change by the correlations of
    each frame's own numbers."""
    covariance = computed.covariance
    information, miss = np.zeros(covariance.shape[:2]), np.zeros(covariance.shape[:2])
    for term in problem.frames:
        columns = term.columns(at)
        information[:, columns] += term.information(components)
        miss[:, columns] += term.miss(at)
    counted = np.stack([its.counted for its in found])
    of = counted > 0.0
    moved = 2.0 * computed.moved(np.moveaxis(of * (miss * information), 0, -1))
    kept = covariance * information[:, None, :]
    both = kept * np.swapaxes(kept, 1, 2)
    out = np.zeros((len(found), len(found)))
    for k, its in enumerate(found):
        if not its.follows:
            continue
        squares = 2.0 * np.einsum("fd,fdl->l", its.counted * its.miss * information, moved) / its.squares
        own = (of[k] * np.diagonal(kept, axis1=1, axis2=2)).sum()
        redundancy = -2.0 * np.einsum("fi,fij,lfj->l", of[k], both, of) / its.redundancy
        redundancy[k] += 2.0 * own / its.redundancy
        squares[k] -= 2.0
        out[k] = 0.5 * (squares - redundancy)
        out[k, k] += 1.0
        out[k] *= its.follows
    return out


@dataclass(frozen=True)
class _Computed:
    """The numbers of frames that terms observe, as the unknowns give them. by_pose (f, d, d) and by_shared
    (f, d, s) are derivatives by each frame's unknowns and by the shared ones. covariance (f, d, d) is that of
    the numbers for unit weight, shared (s, s) that of the shared unknowns. An offset or a boresight is part
    of what is computed: the pose alone varies far more, as the two compensate each other."""

    reduced: Reduced
    by_pose: Floats
    by_shared: Floats
    covariance: Floats
    shared: Floats

    @classmethod
    def of(cls, problem: BlockProblem, at: Estimate, reduced: Reduced) -> _Computed:
        """Of all terms of the frames."""
        covariance, shared = reduced.covariance()
        (f, d), s, slices = covariance.shape[:2], len(shared), at.layout.slices
        by_pose, by_shared = np.tile(np.eye(d), (f, 1, 1)), np.zeros((f, d, s))
        for term in problem.frames:
            columns, (of_poses, of_shared) = term.columns(at), term.derivatives(at)
            if of_poses is not None:
                by_pose[:, columns, :6] = of_poses
            for name, of in of_shared:
                if name in slices:
                    by_shared[:, columns, slices[name]] = of
        if by_shared.any():
            across = by_pose @ reduced.across_covariance(shared) @ np.swapaxes(by_shared, 1, 2)
            covariance = by_pose @ covariance @ np.swapaxes(by_pose, 1, 2) + across
            covariance += np.swapaxes(across, 1, 2) + by_shared @ shared @ np.swapaxes(by_shared, 1, 2)
        return cls(reduced, by_pose, by_shared, covariance, shared)

    def variances(self, columns: slice) -> Floats:
        """Of what a term observes, (f, k)."""
        return np.diagonal(self.covariance, axis1=1, axis2=2)[:, columns]

    def placed(self, component: Component, columns: slice) -> Component:
        """A component of a term with all d numbers of the frames."""
        counted, miss = np.zeros((2, *self.covariance.shape[:2]))
        counted[:, columns], miss[:, columns] = component.counted, component.miss
        return replace(component, counted=counted, miss=miss)

    def moved(self, pull: Floats) -> Floats:
        """By how much the numbers move, (f, d, r), for r pulls on them, (f, d, r), if all others follow."""
        poses = np.swapaxes(self.by_pose, 1, 2) @ pull
        poses, shared = self.reduced.moved(poses, np.einsum("fds,fdr->sr", self.by_shared, pull))
        return np.asarray(self.by_pose @ poses + self.by_shared @ shared)
