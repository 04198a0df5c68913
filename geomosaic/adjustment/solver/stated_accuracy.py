"""What the normal equations of a solution state of its accuracy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geomosaic.adjustment.kernels.reduced_equations import Reduced, reduce_normals
from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Poses


@dataclass(frozen=True)
class StatedAccuracy:
    """Covariances, scaled with the estimated variance components.

    solved: the normal equations; reduced: those whose covariances hold what is not known of held unknowns, as
    all others here. pose_covariance (f, 6, 6): of east, north, up (m) and turns about them (rad); pose_sd
    (f, 6). shared_sd (s,), shared_correlation (s, s): of the shared unknowns.
    """

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
    if problem.held is not None and problem.held.any():
        reduced = reduced.considering(np.where(problem.held, layout.sd, 0.0) ** 2)
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
