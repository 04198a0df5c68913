"""Covariance of places on the ground, and the design effect of image errors that frames share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.ground_places import GroundPlaces
from geomosaic.adjustment.solver.solution import Solution, stated_accuracy
from geomosaic.arrays import Floats, Ints
from geomosaic.constants import tuned
from geomosaic.estimation.linear import orthonormal
from geomosaic.estimation.robust import median_of_known
from geomosaic.matching.tracks import Tracks

_POINTS = tuned(48, "tie points", "fewer: bends of a long block are missed; more: three columns each")
_LEAST_POINTS = tuned(4, "tie points", "a similarity takes four numbers of their eight")
_WELL_KNOWN = tuned(3.0, "times the median deviation of a point", "more: rays that hardly cut; less: no rim")


@dataclass(frozen=True)
class PlaceDerivatives:
    """Derivatives of tie points (k, 3) far from each other, by poses (f, d, 3 k) and shared unknowns (s, 3
    k), by place, then axis. The noise of the points' own image coordinates is left out, since a map does not
    have it."""

    places_m: Floats
    by_pose: Floats
    by_shared: Floats


def place_derivatives(solution: Solution, ties: int) -> PlaceDerivatives | None:
    """Derivatives of places spread over the block; None for less than four points. Args: ties: how many of
    the solution's points are tie points, which come first."""
    reduced = solution.stated.solved
    n = reduced.normals
    f, d = n.pose_side.shape
    sd_m = np.linalg.norm(solution.points_sd_m[:ties], axis=1)
    known = np.flatnonzero(sd_m <= _WELL_KNOWN * median_of_known(sd_m))
    chosen = known[_spread_out(solution.points_m[known, :2])]
    if len(chosen) < _LEAST_POINTS:
        return None
    by_pose = np.zeros((f, d, 3 * len(chosen)))
    by_shared = np.zeros((len(reduced.shared), 3 * len(chosen)))
    c, k = n.interior_side.shape
    for j, p in enumerate(chosen):
        inverse, columns = reduced.points_inverse[p], slice(3 * j, 3 * j + 3)
        for o in np.flatnonzero(n.sightings.point == p):
            by_pose[n.sightings.frame[o], :, columns] -= (inverse @ n.point_pose(int(o))).T
        by_interior = np.einsum("ai,cki->cka", inverse, n.interior_point[:, p])
        by_shared[: c * k, columns] = -by_interior.reshape(-1, 3)
        by_shared[c * k, columns] = -inverse @ n.level_point[p]
    return PlaceDerivatives(solution.points_m[chosen], by_pose, by_shared)


def ground_places(solution: Solution, ties: int) -> GroundPlaces | None:
    """Tie points far from each other and their covariance by poses and shared unknowns, fixed ones included
    (`Reduced.considering`); None for less than four points. Raises: NotSolvableError where the equations have
    no solution."""
    its = place_derivatives(solution, ties)
    if its is None:
        return None
    return GroundPlaces(its.places_m, solution.stated.reduced.propagate(its.by_pose, its.by_shared))


def _spread_out(plan: Floats) -> Ints:
    """Points far from each other, each the farthest from all before."""
    if not len(plan):
        return np.zeros(0, dtype=np.intp)
    chosen = [int(np.linalg.norm(plan - np.median(plan, axis=0), axis=1).argmin())]
    away = np.linalg.norm(plan - plan[chosen[0]], axis=1)
    while len(chosen) < min(_POINTS, len(plan)):
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(plan - plan[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.intp)


@dataclass(frozen=True)
class DesignEffect:
    """How many image observations count as one, by a solve with `by_frame` a frame; sd: its uncertainty."""

    value: float
    sd: float
    by_frame: float

    def among(self, tracks: Tracks) -> float:
        """The design effect to expect of other observations of the same images: 1 + (m - 1) r, with m
        observations in a frame. Here r is the correlation of two of them (Kish 1965, section 5.4), less one
        deviation, since chance grows with m too."""
        shared = max(self.value - self.sd - 1.0, 0.0) / max(self.by_frame - 1.0, 1.0)
        return 1.0 + max(_in_a_frame(tracks.frame) - 1.0, 0.0) * shared


def with_design_effect(solution: Solution, ties: int) -> Solution:
    """The solution with covariances as if its image observations were fewer by their design effect. Raises:
    NotSolvableError where the equations have no solution."""
    factor = design_effect(solution, ties).value
    if factor == solution.problem.image.design_effect:
        return solution
    image = replace(solution.problem.image, design_effect=factor)
    problem = replace(solution.problem, image=image)
    stated = stated_accuracy(problem, solution.estimate, solution.components)
    return replace(solution, problem=problem, stated=stated, poses=stated.of(solution.poses))


def design_effect(solution: Solution, ties: int) -> DesignEffect:
    """How many times the variance of the map's shape is what it would be if image errors were independent; 1
    where too little is known.

    An unmodelled lens, wind or shutter shifts many image points of a frame alike. This is the design effect
    of a sample in clusters (Kish 1965, Survey Sampling, section 8.2), with frames as clusters. Scores are
    summed by frame; the sums' squares are divided by the sum of the scores' squares, as in the robust
    covariance of Liang and Zeger (1986, theorem 2). The scores are those of what shifts, tilts, stretches and
    bends the map, each divided by its standard deviation. The factor n / (n - p) corrects for n frames and p
    numbers of lenses (MacKinnon and White 1985, HC1). Args: ties: see `place_derivatives`. Raises:
    NotSolvableError where the equations have no solution.
    """
    its, reduced = place_derivatives(solution, ties), solution.stated.solved
    if its is None:
        return DesignEffect(1.0, 0.0, 1.0)
    bends = _bends(its.places_m)
    by_pose, by_shared = its.by_pose @ bends, its.by_shared @ bends
    pose, shared = reduced.moved(by_pose, by_shared)
    variance = np.sum(by_pose * pose, axis=(0, 1)) + np.sum(by_shared * shared, axis=0)
    known = variance > 0.0
    root = np.sqrt(variance[known])
    by_frame, alone = _scores(solution, pose[..., known] / root, shared[:, known] / root)
    frame = solution.problem.tracks.frame
    by_frame = by_frame[:, np.bincount(frame, minlength=len(solution.poses)) > 0]
    by_frame -= by_frame.mean(axis=1, keepdims=True)  # what draws all frames alike is the priors' pull
    seeing = by_frame.shape[1]
    if alone <= 0.0:
        return DesignEffect(1.0, 0.0, 1.0)
    fitted = seeing / max(seeing - _determined(solution), 1.0)
    together = fitted * np.square(by_frame).sum(axis=0) / alone
    sd = float(together.std() * np.sqrt(seeing))
    return DesignEffect(max(float(together.sum()), 1.0), sd, _in_a_frame(frame))


def _in_a_frame(frame: Ints) -> float:
    """Observations in the frame of an observation, itself included, in the mean."""
    counts = np.bincount(frame).astype(np.float64)
    return float(np.square(counts).sum() / max(counts.sum(), 1.0))


def _determined(solution: Solution) -> float:
    """How many numbers of the lenses the images determine, undetermined ones counted in part."""
    layout = solution.estimate.layout
    prior, sd = layout.sd[layout.interior], solution.stated.shared_sd[layout.interior]
    free = (prior > 0.0) & ~solution.fixed[layout.interior]
    return float(np.maximum(1.0 - (sd[free] / prior[free]) ** 2, 0.0).sum())


def _scores(solution: Solution, pose: Floats, shared: Floats) -> tuple[Floats, float]:
    """By how much image observations draw quantities away from the solution: sums by frame (r, f), and the
    sum of all squares. Args: pose (f, d, r), shared (s, r): see `Reduced.moved`."""
    image, at, reduced = solution.problem.image, solution.estimate, solution.stated.solved
    sightings, columns = reduced.normals.sightings, range(shared.shape[1])
    interior = shared[: reduced.level].reshape(*at.interior.shape, -1)
    linearised = image.linearised(at, solution.components)
    by_frame, squares = np.zeros((len(columns), sightings.frames)), 0.0
    for group in sightings.groups:
        residual, weight, levers, by_interior, by_point = linearised(
            sightings.order[group.span].astype(np.intp)
        )
        frame, none = sightings.frame[group.span], np.zeros((group.size, 3))
        point, drawn = sightings.point[group.span] - group.points.start, weight * residual
        by_camera = np.einsum("an,akn->kn", drawn, by_interior)
        by_place = np.einsum("an,ain->in", drawn, by_point)
        for j in columns:
            points_m = reduced.group_moved(group, pose[..., j], shared[:, j], none)
            moved_m = levers.as_points_m(pose[frame, :, j].T) + points_m[point].T
            lens = interior[image.camera_of[frame], :, j].T
            score = (by_place * moved_m).sum(axis=0) + (by_camera * lens).sum(axis=0)
            by_frame[j] += np.bincount(frame, score, sightings.frames)
            squares += float(np.square(score).sum())
    return by_frame, squares


def _bends(places_m: Floats) -> Floats:
    """Errors of places by polynomials of the second degree in plan, in each axis, (3 k, r), orthonormal. r is
    18 at most."""
    east, north = ((places_m - places_m.mean(axis=0)) / np.ptp(places_m, axis=0).max())[:, :2].T
    plan = np.stack([np.ones(len(east)), east, north, east**2, east * north, north**2], axis=1)
    return np.asarray(np.kron(orthonormal(plan), np.eye(3)))
