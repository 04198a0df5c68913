"""A solution with its stated accuracy, and what another solve begins from."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from geomosaic.adjustment.kernels.interior import interior_of
from geomosaic.adjustment.kernels.reduced_equations import Reduced, reduce_normals
from geomosaic.adjustment.model import SharedUnknowns, SolveStep
from geomosaic.adjustment.problem.estimate import Estimate, UnknownLayout
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Bools, Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera


@dataclass(frozen=True)
class StatedAccuracy:
    """Covariances, scaled with the estimated variance components. solved: the normal equations; reduced:
    those that all others are from, in which fixed unknowns keep their prior variance. pose_covariance (f, 6,
    6): of east, north, up (m) and turns about them (rad); pose_sd (f, 6). shared_sd (s,), shared_correlation
    (s, s): of the shared unknowns."""

    solved: Reduced
    reduced: Reduced
    pose_covariance: Floats
    pose_sd: Floats
    shared_sd: Floats
    shared_correlation: Floats

    def of(self, poses: Poses) -> Poses:
        """Poses with their deviations."""
        return replace(poses, positions_sd_m=self.pose_sd[:, :3], rotations_sd_rad=self.pose_sd[:, 3:])


def stated_accuracy(problem: BlockProblem, at: Estimate, components: Components) -> StatedAccuracy:
    """By the normal equations at a solution. Raises: NotSolvableError where they have no solution."""
    layout = at.layout
    solved = reduced = reduce_normals(problem.normals(at, components))
    if problem.fixed is not None and problem.fixed.any():
        reduced = reduced.considering(np.where(problem.fixed, layout.sd, 0.0) ** 2)
    covariance, shared = reduced.covariance()
    covariance = covariance[:, :6, :6]
    before = np.column_stack([term.sd(components) for term in problem.frames[:2]])
    shared_sd = deviations(np.diag(shared), problem.shared_sd(layout))
    return StatedAccuracy(
        solved,
        reduced,
        covariance,
        deviations(np.diagonal(covariance, axis1=1, axis2=2), before),
        shared_sd,
        shared / shared_sd[:, None] / shared_sd,
    )


def deviations(variance: Floats, before: Floats) -> Floats:
    """Their roots; the deviations before the solve where rounding left none above zero."""
    return np.asarray(np.where(variance > 0.0, np.sqrt(np.maximum(variance, 0.0)), before))


@dataclass(frozen=True)
class Start:
    """What another solve goes on from: poses and cameras, the estimate, the variance components, fixed shared
    unknowns (s,), and the factor of the image deviation about each point (p,), None where unknown."""

    poses: Poses
    cameras: tuple[Camera, ...]
    estimate: Estimate
    components: Components
    fixed: Bools
    local: Floats | None

    @property
    def points_m(self) -> Floats:
        """(p, 3)"""
        return self.estimate.points_m

    def of_points(self, points_m: Floats, cameras: tuple[Camera, ...] | None = None) -> Start:
        """The same with other points, about which nothing else is known, and other lenses."""
        start = Start(**{f.name: getattr(self, f.name) for f in fields(Start)})
        cameras = cameras or self.cameras
        shared = self.estimate.shared.copy()
        shared[self.estimate.layout.interior] = np.concatenate([interior_of(c) for c in cameras])
        estimate = replace(self.estimate, points_m=points_m, shared=shared)
        return replace(start, cameras=cameras, estimate=estimate, local=None)

    def shared_in(self, layout: UnknownLayout) -> tuple[Floats, Bools]:
        """Values of the shared unknowns and whether they are fixed, by name in the order of another layout;
        prior values where unknown."""
        values, fixed = layout.given.copy(), np.zeros(layout.size, dtype=bool)
        for name, mine in self.estimate.layout.slices.items():
            its = layout.slices.get(name)
            if its is not None:
                values[its], fixed[its] = self.estimate.shared[mine], self.fixed[mine]
        return values, fixed


@dataclass(frozen=True)
class Solution(Start):
    """The solution of a block.

    problem: with the last robust weights and fixed unknowns. points_sd_m (p, 3): as if poses and cameras were
    known. stated: covariances of poses and shared unknowns. implausible (s,): those fixed because the images
    draw them where no lens has them. residual_px (m, 2): observed minus computed. weight (m,): robust
    weights, 1 for a good observation. left_out (f,): frames that could not be solved for. readout_score (c,):
    of readout times of 0 that nothing reports, see `with_unreported_readouts`. steps: of the solve.
    """

    problem: BlockProblem
    points_sd_m: Floats
    stated: StatedAccuracy
    implausible: Bools
    residual_px: Floats
    weight: Floats
    left_out: Bools
    readout_score: Floats
    steps: tuple[SolveStep, ...] = ()

    def of_ties(self, points: int, observations: int) -> Solution:
        """The solution without control points, which come last."""
        return replace(
            self,
            estimate=replace(self.estimate, points_m=self.points_m[:points]),
            points_sd_m=self.points_sd_m[:points],
            residual_px=self.residual_px[:observations],
            weight=self.weight[:observations],
            local=None if self.local is None else self.local[:points],
        )

    def shared_unknowns(self) -> SharedUnknowns:
        """The shared unknowns that are not known beforehand, without the ground's level, in the units of
        their names."""
        layout = self.estimate.layout
        rows = np.flatnonzero((layout.sd > 0.0) & (np.arange(layout.size) != layout.level))
        names, unit = layout.names, layout.unit[rows]
        return SharedUnknowns(
            of=tuple(names[k][0] for k in rows),
            names=tuple(names[k][1] for k in rows),
            given=layout.given[rows] / unit,
            found=self.estimate.shared[rows] / unit,
            sd=self.stated.shared_sd[rows] / unit,
            correlation=self.stated.shared_correlation[np.ix_(rows, rows)],
            held=self.fixed[rows],
        )
