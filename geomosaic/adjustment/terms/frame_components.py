"""Variance components and robust weights of observations of the frames' poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.adjustment.terms.term import LEAST_REDUNDANCY, Component
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import MEDIAN_LENGTH, MEDIAN_ONE, tuned
from geomosaic.estimation.robust import credible, lie_weight, median_of_known

PRIOR_FACTORS = tuned((0.1, 10.0), "times the stated deviation", "beyond: tags are not what they claim")
_A_LITTLE = tuned(1.01, "times a factor", "by which its slope is found by difference")


@dataclass(frozen=True)
class FrameGroup:
    """Numbers of the frames with one variance component.

    counted, sd, weight, own (f, k): which numbers belong to it, stated deviations with the present factor,
    robust weights, residuals less what frames have in common. parts: frames of each connected part; common:
    unknowns that the frames of a part have in common; more: such unknowns beyond that.
    """

    name: str
    counted: Bools
    sd: Floats
    weight: Floats
    own: Floats
    parts: tuple[Ints, ...]
    common: float
    more: float = 0.0

    def component(self, factor: float, share: Floats, unknowns: int, first: int) -> Component:
        """The variance component by residuals and redundancy (Foerstner 1979).

        What all frames of a part have in common does not show the deviation of one; else a block at a wrong
        scale would widen it. Args: factor: the present one; share (f, k): of each number, what the other
        observations leave of its variance; unknowns d of a frame, of which these begin at `first`.
        """
        stated: Bools = np.isfinite(self.sd) & self.counted
        weight = np.where(stated, self.weight, 0.0)
        in_all = np.where(self.counted, self.weight, 0.0).sum(axis=1)
        alone = float(sum(max(in_all[frames].sum() - self.common, 0.0) for frames in self.parts)) - self.more
        r = min(float((weight - share)[stated].sum()), alone)
        miss = np.where(stated, self.own, 0.0)
        padding = (0, 0), (first, unknowns - first - weight.shape[1])
        counted = np.pad(weight, padding), np.pad(miss, padding)
        least, most = PRIOR_FACTORS
        if r < LEAST_REDUNDANCY:
            return Component(self.name, factor, *counted, least=least, most=most)
        squares = float((weight * (miss / self.sd) ** 2)[stated].sum())
        scatter = factor * float(np.sqrt(squares / r))
        found, above = (credible(f, r) for f in (scatter, _A_LITTLE * scatter))
        follows = float(np.log(above / found) / np.log(_A_LITTLE)) if least < found < most else 0.0
        found = float(np.clip(found, least, most))
        return Component(self.name, found, *counted, squares, r, follows, least, most)


def robust_weights(
    standardised: Floats, observed: Bools, parts: Sequence[Ints], groups: Sequence[list[int]]
) -> Floats:
    """Weights (f, k) of residuals over their deviations (f, k), group of columns by group.

    A frame is wrong against the bulk of the others, never all at once: else a block that shrinks or tips
    over would free itself from its positions. Args: observed (f, k); parts: those of more than two frames
    show the bulk.
    """
    large = [frames for frames in parts if len(frames) > 2]
    tied = np.concatenate(large or [np.arange(len(standardised))])
    out = np.ones_like(standardised)
    for columns in groups:
        length = np.linalg.norm(standardised[:, columns], axis=1)
        typical = MEDIAN_LENGTH if len(columns) == 2 else MEDIAN_ONE
        bulk = max(1.0, median_of_known(length[tied[observed[tied, columns[0]]]]) / typical)
        out[:, columns] = lie_weight(length / bulk)[:, None]
    return out
