"""Variance components, robust weights and common parts of the residuals of frames or points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.adjustment.terms.term import Component
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import MEDIAN_LENGTH, MEDIAN_ONE, tuned
from geomosaic.estimation.linear import singular_values
from geomosaic.estimation.robust import STRONG, credible, irls, median_of_known, redescending_weight

PRIOR_FACTORS = tuned((0.1, 10.0), "times the stated deviation", "beyond: tags are not what they claim")


def robust_fit(design: Floats, residuals: Floats, sd: Floats) -> tuple[Floats, Floats, Floats]:
    """Fitted values (k, n), parameters (q,) and weights (k, n) of least squares, re-weighted from the median
    residual on; residuals count by `redescending_weight` of their lengths over the median one. Args: design
    (k, n, q), residuals and sd (k, n)."""
    typical = MEDIAN_LENGTH if residuals.shape[1] == 2 else MEDIAN_ONE

    def weigh(left: Floats) -> Floats:
        length = np.linalg.norm(left / sd, axis=1)
        bulk = max(float(np.median(length)) / typical, 1e-9)
        return np.asarray(redescending_weight(length / bulk)[:, None] / sd**2)

    found, weight = irls(design, residuals, weigh)
    return design @ found, found, weight


def common_similarity(at_m: Floats, miss_m: Floats, sd_m: Floats) -> Floats:
    """Residuals in plan (k, 2) that a similarity of positions explains; all for two frames or fewer."""
    k = len(at_m)
    if k < 3 or not np.isfinite(sd_m).all():
        return np.where(np.isfinite(sd_m), miss_m, 0.0)
    e, n = (at_m - np.median(at_m, axis=0)).T
    zero, one = np.zeros(k), np.ones(k)
    design = np.stack([np.stack([one, zero, -n, e], 1), np.stack([zero, one, e, n], 1)], 1)
    return robust_fit(design, miss_m, sd_m)[0]


def common_slope(at_m: Floats, miss_m: Floats, sd_m: Floats, may_rad: float) -> Floats:
    """The part of residuals in height (k,) that a plane explains. It is their common height alone where the
    slope may be chance (Schwarz 1978) or is steeper than may_rad. In the latter case heights drift or jump,
    and the block has not tilted."""
    level = np.full(len(at_m), common_mean(miss_m, sd_m))
    if len(at_m) < 4 or not np.isfinite(sd_m).all():
        return level
    away_m = at_m - np.median(at_m, axis=0)
    _, sizes, axes = singular_values(away_m)  # none across a single line
    design = np.column_stack([np.ones(len(at_m)), away_m @ axes[sizes > 1e-3 * sizes[0]].T])
    fitted, parameters, weight = robust_fit(design[:, None], miss_m[:, None], sd_m[:, None])
    plane = fitted[:, 0]
    squares = [float(weight[:, 0] @ (miss_m - its) ** 2) for its in (level, plane)]
    evidence = 0.5 * len(at_m) * np.log(max(squares[0], 1e-300) / max(squares[1], 1e-300)) - np.log(len(at_m))
    steep = np.arctan(np.linalg.norm(parameters[1:])) > may_rad
    return np.asarray(level if steep or evidence <= np.log(STRONG) else plane)


def common_mean(miss: Floats, sd: Floats) -> float:
    """The robust mean of residuals (k,), 0 where none has a finite deviation."""
    known = np.isfinite(sd)
    if not known.any():
        return 0.0
    one = np.ones((int(known.sum()), 1, 1))
    return float(robust_fit(one, miss[known, None], sd[known, None])[1][0])


@dataclass(frozen=True)
class FrameGroup:
    """Numbers of the frames with one variance component. counted, sd, weight, own (f, k): which numbers
    belong to it, stated deviations with the present factor, robust weights, residuals without what frames
    have in common. parts: frames of each connected part; common: unknowns that the frames of a part have in
    common; more: such unknowns beyond that."""

    name: str
    counted: Bools
    sd: Floats
    weight: Floats
    own: Floats
    parts: tuple[Ints, ...]
    common: float
    more: float = 0.0

    def component(self, factor: float, share: Floats) -> Component:
        """The variance component by residuals and redundancy (Foerstner 1979), without what all frames of a
        part have in common: a block at a wrong scale would widen it. Args: factor: the present one; share (f,
        k): of each number, what the other observations leave of its variance."""
        stated: Bools = np.isfinite(self.sd) & self.counted
        weight = np.where(stated, self.weight, 0.0)
        in_all = np.where(self.counted, self.weight, 0.0).sum(axis=1)
        alone = float(sum(max(in_all[frames].sum() - self.common, 0.0) for frames in self.parts)) - self.more
        r = min(float((weight - share)[stated].sum()), alone)
        miss = np.where(stated, self.own, 0.0)
        squares = float((weight * (miss / self.sd) ** 2)[stated].sum())
        present = Component(self.name, factor, weight, miss, squares, r, 0.0, *PRIOR_FACTORS)
        return present.estimated(credible)


def robust_weights(
    standardised: Floats, observed: Bools, parts: Sequence[Ints], groups: Sequence[list[int]]
) -> Floats:
    """Weights (f, k) of residuals over their deviations (f, k), by group of columns. A frame is wrong against
    the bulk of the others, never all at once: else a shrinking block would free itself from its positions.
    Args: observed (f, k); parts: those of more than two frames show the bulk."""
    large = [frames for frames in parts if len(frames) > 2]
    tied = np.concatenate(large or [np.arange(len(standardised))])
    out = np.ones_like(standardised)
    for columns in groups:
        length = np.linalg.norm(standardised[:, columns], axis=1)
        typical = MEDIAN_LENGTH if len(columns) == 2 else MEDIAN_ONE
        bulk = max(1.0, median_of_known(length[tied[observed[tied, columns[0]]]]) / typical)
        out[:, columns] = redescending_weight(length / bulk)[:, None]
    return out
