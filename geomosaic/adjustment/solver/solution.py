"""A solution: its stated accuracy, what the block determines, and what another solve begins from."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from geomosaic.adjustment.kernels.interior import READOUT, interior_of
from geomosaic.adjustment.kernels.reduced_equations import Reduced, reduce_normals
from geomosaic.adjustment.model import SharedUnknowns, SolveStep
from geomosaic.adjustment.problem.estimate import Estimate, UnknownLayout
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.linear import inverse

_DETERMINED = tuned(0.7, "share of the prior deviation", "more: what images hardly show goes astray")
_ERRORS_ALIKE = tuned(5.0, "times the image deviation", "neighbouring keypoints err alike; 1: lenses 9 % off")
_INFORMATIVE = tuned(600, "image observations a frame", "more show nothing new of what all frames share")


def undetermined(problem: BlockProblem, at: Estimate, components: Components) -> Bools:
    """Which optional shared unknowns the block does not determine, (s,): the worst first, until all others
    are; all where their covariance is singular. A number is determined if with image errors _ERRORS_ALIKE
    times as large its deviation is still below _DETERMINED of its prior deviation. Keypoints err alike along
    a track and among neighbours, so that the redundancy of many tracks is smaller than it looks."""
    layout = at.layout
    many = len(problem.tracks.frame) / (_INFORMATIVE * len(at.positions_m))
    wider = components.also({IMAGE: _ERRORS_ALIKE * max(1.0, float(np.sqrt(many))) * components[IMAGE]})
    shared = reduce_normals(replace(problem, fixed=None).normals(at, wider)).shared_covariance()
    sd = np.where(layout.optional, layout.sd, 0.0)
    free = np.flatnonzero(sd > 0.0)
    weak = free[_weak(shared[np.ix_(free, free)] / np.outer(sd[free], sd[free]))]
    return np.isin(np.arange(sd.size), weak)


def _weak(covariance: Floats) -> Ints:
    """The numbers of a covariance (n, n) over prior variances that have to be known, the worst first, until
    the deviations of all others are below _DETERMINED."""
    left, out = np.arange(len(covariance)), []
    try:
        inverse(covariance)
    except NotSolvableError:  # singular: rounding would choose
        return left
    while left.size:
        variance = np.diag(covariance)
        variance = np.where(variance < 0.0, np.inf, variance)
        worst = int(variance.argmax())
        if variance[worst] < _DETERMINED**2:
            break
        out.append(left[worst])
        of_worst, others = covariance[worst], np.arange(left.size) != worst
        covariance = covariance - np.outer(of_worst, of_worst) / of_worst[worst]
        covariance, left = covariance[np.ix_(others, others)], left[others]
    return np.array(out, dtype=np.intp)


def with_unreported_readouts(
    problem: BlockProblem, at: Estimate, components: Components
) -> tuple[BlockProblem, Floats]:
    """The problem whose fixed, unreported readout times carry what they may be off by, and their scores,
    (c,). The prior deviation of such a readout (0) becomes the step that the images ask for, with the step's
    own deviation. The score is the step by its deviation (Rao 1948), which shows what is far below the noise
    of one image."""
    layout, none = at.layout, np.zeros(len(problem.cameras))
    unreported = np.array([0.0 if c.readout_s else c.readout_sd_s for c in problem.cameras])
    unreported[layout.of_readouts(layout.sd) > 0.0] = 0.0
    moving = problem.image.reported.velocities_m_per_s is not None
    if not moving or problem.fixed is None or not unreported.any():
        return problem, none
    readouts = np.arange(len(none)) * at.interior.shape[1] + READOUT
    asked, fixed = unreported > 0.0, problem.fixed.copy()
    fixed[readouts] &= ~asked
    free = _with_readout_sd(replace(problem, fixed=fixed), layout.of_readouts(layout.sd) + unreported)
    begun = replace(at, layout=free.layout)
    reduced = reduce_normals(free.normals(begun, components))
    step_s = reduced.solve()[1].ravel()[readouts]
    own_s = np.sqrt(np.diag(reduced.covariance()[1])[readouts])
    sd_s = np.where(asked, np.hypot(step_s, own_s), layout.of_readouts(free.layout.sd))
    fixed = problem.fixed.copy()
    fixed[readouts] |= asked
    return replace(_with_readout_sd(problem, sd_s), fixed=fixed), np.where(asked, step_s / own_s, 0.0)


def _with_readout_sd(problem: BlockProblem, sd_s: Floats) -> BlockProblem:
    """With other prior deviations of the readout times (c,)."""
    parts = []
    for part, its in zip(problem.interior, sd_s, strict=True):
        sd = part.sd.copy()
        sd[READOUT] = its
        parts.append(replace(part, sd=sd))
    image = replace(problem.image, rolling=problem.image.rolling or bool(np.any(sd_s)))
    return replace(problem, interior=tuple(parts), image=image)


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
    """What another solve goes on from: poses and cameras, the estimate, the variance components, and the
    fixed shared unknowns (s,). local (p,): factor of the image deviation about each point, None where
    unknown."""

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
        """See `UnknownLayout.begun_from`."""
        mine = self.estimate.layout.slices.items()
        return layout.begun_from({name: (self.estimate.shared[at], self.fixed[at]) for name, at in mine})


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
        """Shared unknowns not known beforehand, without the ground level, in the units of their names."""
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
            fixed=self.fixed[rows],
        )
