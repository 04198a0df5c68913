"""Image errors that a frame's observations have in common, and what they add to the stated covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.kernels.observation_groups import AT_ONCE
from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.solver.place_uncertainty import place_derivatives
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.solver.stated_accuracy import stated_accuracy
from geomosaic.arrays import Floats, Ints
from geomosaic.estimation.linear import orthonormal


@dataclass(frozen=True)
class DesignEffect:
    """How many image observations count as one, at least 1, by a solve with `by_frame` in each frame;
    sd: what the scatter of frames leaves open."""

    value: float
    sd: float
    by_frame: float

    def among(self, tracks: Tracks) -> float:
        """What is to be expected of other observations of the same images: 1 + (m - 1) r of m in a frame,
        where r is what two of them have in common (Kish 1965, section 5.4).

        By one deviation less: what chance adds grows with m too.
        """
        shared = max(self.value - self.sd - 1.0, 0.0) / max(self.by_frame - 1.0, 1.0)
        return 1.0 + max(_in_a_frame(tracks.frame) - 1.0, 0.0) * shared


def with_design_effect(solution: Solution, ties: int) -> Solution:
    """The solution with covariances as if its image observations were fewer by their design effect.

    Raises: NotSolvableError where the equations have no solution.
    """
    factor = design_effect(solution, ties).value
    if factor == solution.problem.image.design_effect:
        return solution
    image = replace(solution.problem.image, design_effect=factor)
    problem = replace(solution.problem, image=image)
    stated = stated_accuracy(problem, solution.estimate, solution.components)
    return replace(solution, problem=problem, stated=stated, poses=stated.of(solution.poses))


def design_effect(solution: Solution, ties: int) -> DesignEffect:
    """How many times the variance of the map's shape is what it would be if image errors were independent.

    A lens that the model does not follow, wind, or a shutter draw many image points of a frame alike: these
    count for fewer. The design effect of a sample in clusters (Kish 1965, Survey Sampling, section 8.2), with
    frames as clusters: squares of the sums of their observations' scores by the sum of the scores' squares,
    as in the robust covariance of Liang and Zeger (1986, theorem 2), of what shifts, tilts, stretches and
    bends the map, each by its variance. What all frames were fitted by takes a share of the sums, n frames
    and p numbers of lenses p / n of it (MacKinnon and White 1985, HC1). 1 where too little is known.

    Args: ties: see `place_derivatives`.
    Raises: NotSolvableError where the equations have no solution.
    """
    its, reduced = place_derivatives(solution, ties), solution.stated.solved
    if its is None:
        return DesignEffect(1.0, 0.0, 1.0)
    bends = _bends(its.places_m)
    by_pose, by_shared = its.by_pose @ bends, its.by_shared @ bends
    pose, shared = reduced.moved(by_pose, by_shared)
    variance = np.sum(by_pose * pose, axis=(0, 1)) + np.sum(by_shared * shared, axis=0)
    known = variance > 0.0
    scores = _scores(solution, pose[..., known], shared[:, known]) / np.sqrt(variance[known, None])
    frame, frames = solution.problem.tracks.frame, len(solution.poses)
    by_frame = np.stack([np.bincount(frame, column, frames) for column in scores])
    by_frame = by_frame[:, np.bincount(frame, minlength=frames) > 0]
    by_frame -= by_frame.mean(axis=1, keepdims=True)  # what draws all frames alike is the priors' pull
    alone, seeing = float(np.square(scores).sum()), by_frame.shape[1]
    if alone <= 0.0:
        return DesignEffect(1.0, 0.0, 1.0)
    fitted = seeing / max(seeing - _determined(solution), 1.0)
    together = fitted * np.square(by_frame).sum(axis=0) / alone
    sd = float(together.std() * np.sqrt(seeing))
    return DesignEffect(max(float(together.sum()), 1.0), sd, _in_a_frame(frame))


def _in_a_frame(frame: Ints) -> float:
    """How many others of its frame an observation has beside it, and itself, in the mean."""
    counts = np.bincount(frame).astype(np.float64)
    return float(np.square(counts).sum() / max(counts.sum(), 1.0))


def _determined(solution: Solution) -> float:
    """How many numbers of the lenses the images determine: those that they leave open count in part."""
    layout = solution.estimate.layout
    prior, sd = layout.sd[layout.interior], solution.stated.shared_sd[layout.interior]
    free = (prior > 0.0) & ~solution.held[layout.interior]
    return float(np.maximum(1.0 - (sd[free] / prior[free]) ** 2, 0.0).sum())


def _scores(solution: Solution, pose: Floats, shared: Floats) -> Floats:
    """By how much each image observation draws quantities away from where the solution has them, (r, m).

    Args: pose (f, d, r), shared (s, r): see `Reduced.moved`.
    """
    image, at, reduced = solution.problem.image, solution.estimate, solution.stated.solved
    tracks, none = image.tracks, np.zeros(reduced.normals.point_side.shape)
    columns = range(shared.shape[1])
    points_m = [reduced.points_moved(pose[..., j], shared[:, j], none) for j in columns]
    interior = shared[: reduced.level].reshape(*at.interior.shape, -1)
    linearised = image.linearised(at, solution.components)
    scores = np.empty((len(columns), len(tracks.frame)))
    for which in np.array_split(np.arange(len(tracks.frame)), max(len(tracks.frame) // AT_ONCE, 1)):
        residual, weight, levers, by_interior, by_point = linearised(which)
        frame, point, drawn = tracks.frame[which], tracks.point[which], weight * residual
        by_camera = np.einsum("an,akn->kn", drawn, by_interior)
        by_place = np.einsum("an,ain->in", drawn, by_point)
        for j in columns:
            moved_m = levers.as_points_m(pose[frame, :, j].T) + points_m[j][point].T
            lens = interior[image.camera_of[frame], :, j].T
            scores[j, which] = (by_place * moved_m).sum(axis=0) + (by_camera * lens).sum(axis=0)
    return scores


def _bends(places_m: Floats) -> Floats:
    """Errors of places by polynomials of the second degree in plan, in each axis, (3 k, 18), orthonormal."""
    east, north = ((places_m - places_m.mean(axis=0)) / np.ptp(places_m, axis=0).max())[:, :2].T
    plan = np.stack([np.ones(len(east)), east, north, east**2, east * north, north**2], axis=1)
    return np.asarray(np.kron(orthonormal(plan), np.eye(3)))
