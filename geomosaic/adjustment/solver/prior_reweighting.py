"""Which positions and attitudes are believed: what each misses by itself, who is wild."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.problem.bundle_model import GROUPS, Factors, Priors, State
from geomosaic.adjustment.solver.bundle_equations import pose_sd, present_miss
from geomosaic.constants import MEDIAN_LENGTH, sourced
from geomosaic.estimation.linear import least_squares
from geomosaic.estimation.robust import lie_weight

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
MEDIAN_ONE = sourced(
    0.6745,
    "deviations",
    "median size of a residual of one number with a deviation of 1",
    "normal distribution: Phi^-1(3/4)",
)

_SLOPES = sourced(
    20.0,
    "times likelier",
    "that a part's heights miss by a slope than without one, so that the slope counts as what they miss "
    "in common: strong evidence. Taken off always, 8 frames had too little left to show by what heights "
    "are off",
    "Kass and Raftery 1995, section 3.2",
)


def parts_of(priors: Priors) -> list[Ints]:
    """The frames of each connected part."""
    part = np.zeros(len(priors.poses), np.intp) if priors.part is None else priors.part
    return [np.flatnonzero(part == k) for k in np.unique(part)]


def observed_of(priors: Priors) -> Bools:
    """Which numbers of the poses (f, 6) somebody observed, or believes: all but assumed positions."""
    out = np.ones((len(priors.poses), 6), dtype=bool)
    out[:, :3] &= True if priors.assumed is None else ~priors.assumed[:, None]
    return out


def own_miss(priors: Priors, state: State, factors: Factors) -> tuple[Floats, int]:
    """Given minus present (f, 6), less what the frames of each part miss in common: a similarity of the
    plane, a height that slopes, a heading. Frames that lie don't show what is common. Of assumed positions it
    is 0. The second: of how many parts the height does slope."""
    miss, sd, observed = present_miss(priors, state), pose_sd(priors, factors), observed_of(priors)
    out, slopes = miss.copy(), 0
    for part in parts_of(priors):
        frames = part[observed[part, 0]]
        out[frames, :2] -= common_similarity(state.positions[frames, :2], miss[frames, :2], sd[frames, :2])
        may = float(np.median(priors.poses.rotations_sd_rad[frames, :2])) if len(frames) else 0.0
        common = common_slope(state.positions[frames, :2], miss[frames, 2], sd[frames, 2], may)
        slopes += bool(len(frames)) and bool(np.ptp(common))
        out[frames, 2] -= common
        frames = part[observed[part, 5]]
        out[frames, 5] -= _common(miss[frames, 5], sd[frames, 5])
    return np.where(observed, out, 0.0), slopes


def common_similarity(at_m: Floats, miss_m: Floats, sd_m: Floats) -> Floats:
    """What shift, turn and scale of all positions explain of their misses (k, 2), by re-weighting from the
    median shift on; of two frames or fewer all."""
    k = len(at_m)
    if k < 3 or not np.isfinite(sd_m).all():
        return np.where(np.isfinite(sd_m), miss_m, 0.0)
    e, n = (at_m - np.median(at_m, axis=0)).T
    zero, one = np.zeros(k), np.ones(k)
    design = np.stack([np.stack([one, zero, -n, e], 1), np.stack([zero, one, e, n], 1)], 1)
    found = np.zeros((k, 2)) + np.median(miss_m, axis=0)
    for _ in range(10):
        length = np.linalg.norm((miss_m - found) / sd_m, axis=1)
        weight = (
            np.sqrt(lie_weight(length / max(float(np.median(length)) / MEDIAN_LENGTH, 1e-9)))[:, None] / sd_m
        )
        rows = (design * weight[:, :, None]).reshape(2 * k, 4)
        scale = np.linalg.norm(rows, axis=0) + 1e-12
        solved = least_squares(rows / scale, (miss_m * weight).ravel(), rcond=1e-10) / scale
        found = design @ solved
    return np.asarray(found)


def common_slope(at_m: Floats, miss_m: Floats, sd_m: Floats, may_rad: float) -> Floats:
    """What a height that slopes explains of all misses (k,), by re-weighting from the common height on; a
    height alone where the slope may be chance, by Schwarz's approximation (1978) of the evidence, or where it
    is steeper than attitudes may be off by: then heights drift or jump, and no block has tipped over."""
    level = np.full(len(at_m), _common(miss_m, sd_m))
    if len(at_m) < 4 or not np.isfinite(sd_m).all():
        return level
    found = level
    design = np.column_stack([np.ones(len(at_m)), at_m - np.median(at_m, axis=0)])
    for _ in range(10):
        length = np.abs(miss_m - found) / sd_m
        weight = np.sqrt(lie_weight(length / max(float(np.median(length)) / MEDIAN_ONE, 1e-9))) / sd_m
        rows = design * weight[:, None]
        scale = np.linalg.norm(rows, axis=0) + 1e-12
        plane = least_squares(rows / scale, miss_m * weight, rcond=1e-3) / scale
        found = design @ plane
    squares = [float((((miss_m - its) * weight) ** 2).sum()) for its in (level, found)]
    evidence = 0.5 * len(at_m) * np.log(max(squares[0], 1e-300) / max(squares[1], 1e-300)) - np.log(len(at_m))
    steep = np.arctan(np.hypot(*plane[1:])) > may_rad
    return np.asarray(level if steep or evidence <= np.log(_SLOPES) else found)


def _common(miss: Floats, sd: Floats) -> float:
    """The weighted mean of those near the median."""
    known = np.isfinite(sd)
    if not known.any():
        return 0.0
    miss, sd = miss[known], sd[known]
    found = float(np.median(miss))
    for _ in range(5):
        length = np.abs(miss - found) / sd
        weight = lie_weight(length / max(float(np.median(length)) / MEDIAN_ONE, 1e-9)) / sd**2
        found = float((weight * miss).sum() / weight.sum())
    return found


def trust_in_tags(priors: Priors, state: State, factors: Factors) -> Floats:
    """Weights of each frame's position and attitude, (f, 6), by groups: a wild tag loses its say.

    A frame is wild against the bulk of the others, never all at once: else a whole block that shrinks
    or tips over would free itself from its positions.
    """
    miss = own_miss(priors, state, factors)[0] / pose_sd(priors, factors)
    tied = np.concatenate(
        [frames for frames in parts_of(priors) if len(frames) > 2] or [np.arange(len(miss))]
    )
    trust, observed = np.ones_like(miss), observed_of(priors)
    for columns in map(list, GROUPS.values()):
        length = np.linalg.norm(miss[:, columns], axis=1)
        typical = MEDIAN_LENGTH if len(columns) == 2 else MEDIAN_ONE
        bulk = max(1.0, median_px(length[tied[observed[tied, columns[0]]]]) / typical)
        trust[:, columns] = lie_weight(length / bulk)[:, None]
    return trust


def median_px(lengths_px: Floats) -> float:
    """Median of what is known, else 0."""
    known = lengths_px[np.isfinite(lengths_px)]
    return float(np.median(known)) if known.size else 0.0
