"""Which shared unknowns a block determines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.kernels.interior import READOUT
from geomosaic.adjustment.kernels.reduced_equations import reduce_normals
from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Bools, Floats
from geomosaic.constants import tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.linear import inverse

_DETERMINED = tuned(0.7, "share of the prior deviation", "more: what images hardly show goes astray")
_ERRORS_ALIKE = tuned(5.0, "times the image deviation", "neighbouring keypoints err alike; 1: lenses 9 % off")
_INFORMATIVE = tuned(600, "image observations a frame", "more show nothing new of what all frames share")


def undetermined(problem: BlockProblem, at: Estimate, components: Components) -> Bools:
    """Which optional shared unknowns the block does not determine, (s,): the worst first, until all others
    are; all where their covariance is singular. A number is determined if with image errors _ERRORS_ALIKE
    times as large its deviation is still below _DETERMINED of its prior deviation: keypoints err alike along
    a track and among neighbours, so that the redundancy of many tracks is smaller than it looks."""
    layout = at.layout
    many = len(problem.tracks.frame) / (_INFORMATIVE * len(at.positions_m))
    wider = components.also({IMAGE: _ERRORS_ALIKE * max(1.0, float(np.sqrt(many))) * components[IMAGE]})
    shared = reduce_normals(replace(problem, fixed=None).normals(at, wider)).shared_covariance()
    sd = np.where(layout.optional, layout.sd, 0.0)
    free = np.flatnonzero(sd > 0.0)
    try:
        shown = inverse(shared[np.ix_(free, free)] / np.outer(sd[free], sd[free])) - np.eye(len(free))
    except NotSolvableError:
        return sd > 0.0
    out, left = np.zeros(sd.size, dtype=bool), np.arange(len(free))
    while left.size:
        variance = np.diag(inverse(shown[np.ix_(left, left)] + np.eye(left.size)))
        share = np.sqrt(np.where(variance < 0.0, np.inf, variance))
        worst = int(share.argmax())
        if share[worst] < _DETERMINED:
            break
        out[free[left[worst]]] = True
        left = np.delete(left, worst)
    return out


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
    free = _with_readout_sd(problem, layout.of_readouts(layout.sd) + unreported)
    begun = replace(at, layout=free.layout)
    reduced = reduce_normals(free.normals(begun, components))
    step_s = reduced.solve()[1].ravel()[readouts]
    own_s = np.sqrt(np.diag(reduced.covariance()[1])[readouts])
    asked = unreported > 0.0
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
