"""Georeferencing of a part of a block: one scale, one turn, one shift onto what is known on the ground."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.special import chdtrc, fdtrc

from geomosaic.arrays import Complexes, Floats, Ints
from geomosaic.constants import MEDIAN_LENGTH, sourced
from geomosaic.estimation.linear import least_squares
from geomosaic.estimation.robust import LEAST_NOISE, redescending_weight
from geomosaic.estimation.similarity import SAMPLES, similarity_design
from geomosaic.matching.relative import ALIKE

_BY_CHANCE = sourced(0.05, "probability", "usual level of a test", "Fisher 1925, section 12")


@dataclass(frozen=True)
class Fixes:
    """Points known on the ground: nadir points of observed positions, and control points in frames. frame
    (k,): number of the frame. offset (k,): from its assumed nadir point, east + i north in m; 0 for a
    position. at, sd_m (k,): the known place and its deviation."""

    frame: Ints
    offset: Complexes
    at: Complexes
    sd_m: Floats

    def of(self, frames: Ints) -> Fixes:
        """Those of some frames (sorted), renumbered among these."""
        mine = np.isin(self.frame, frames)
        number = np.searchsorted(frames, self.frame[mine])
        return Fixes(number, self.offset[mine], self.at[mine], self.sd_m[mine])


@dataclass(frozen=True)
class PlanPriors:
    """Priors of frames by GNSS and IMU, each (n,). nadir: nadir points, east + i north in m. Standard
    deviations: position_sd_m of the nadir points, yaw_sd_rad of headings, scale_sd of the scale by height and
    focal length, as a share. anywhere_m: deviation of a nadir point of which nothing is known."""

    nadir: Complexes
    position_sd_m: Floats
    yaw_sd_rad: Floats
    scale_sd: Floats
    anywhere_m: Floats

    def of(self, frames: Ints) -> PlanPriors:
        """Those of some frames."""
        return PlanPriors(*(getattr(self, f.name)[frames] for f in fields(self)))


def georeferenced(
    shape: Complexes, place: Complexes, priors: PlanPriors, fixes: Fixes
) -> tuple[complex, complex, Floats]:
    """The similarity, at = whole * place + shift, of a part onto its fixes, and their weights (k,).
    Re-weighted least squares start from the least median of squares (Rousseeuw 1984) and from headings and
    heights, which count as one frame's; the lower cost decides. Fixes that do not determine turn and scale
    only shift the part, as those of an ascent on the spot or a single control point do. Least squares would
    shrink it to a point. Args: shape (n,): turn and scale of each frame against the given ones; place (n,):
    nadir points."""
    given = _by_headings(shape, priors)
    if not len(fixes.at):
        return given, complex(np.mean(priors.nadir - given * place)), np.zeros(0)
    known = place[fixes.frame] + shape[fixes.frame] * fixes.offset
    sd = float(np.median(priors.scale_sd[fixes.frame])), float(min(np.median(priors.yaw_sd_rad), np.pi))
    tried = [_improved(whole, known, given, sd, fixes) for whole in (given, *_by_pairs(known, fixes))]
    _, whole, shift, weight = min(tried, key=lambda t: t[0])
    if _determined(fixes, whole * known + shift, weight):
        return whole, shift, weight
    off = fixes.at - given * known
    return given, complex(np.median(off.real), np.median(off.imag)), weight


def _determined(fixes: Fixes, fitted: Complexes, weight: Floats) -> bool:
    """Whether fixes determine turn and scale: an F test of what a similarity explains of their scatter. Fixes
    which leave no residual, as two do, must be farther apart than their deviations explain (chi-squared)."""
    count = float(weight.sum())
    if not count:
        return False
    scatter = np.abs(fixes.at - (weight @ fixes.at) / count) ** 2
    free, left = 2.0 * count - 4.0, float(weight @ np.abs(fixes.at - fitted) ** 2)
    if free < 1.0 or left == 0.0:
        return bool(chdtrc(2.0, float((weight / fixes.sd_m**2) @ scatter)) < _BY_CHANCE)
    explained = max(float(weight @ scatter) - left, 0.0)
    return bool(fdtrc(2.0, free, explained / 2.0 / (left / free)) < _BY_CHANCE)


def _by_headings(shape: Complexes, priors: PlanPriors) -> complex:
    """Turn and scale of the part by most of its headings and heights."""
    turns = np.conj(shape) / np.abs(shape)
    cost = [np.minimum(np.abs(np.angle(turn * np.conj(turns))), ALIKE).sum() for turn in turns]
    best = turns[int(np.argmin(cost))]
    near = np.abs(np.angle(turns * np.conj(best))) < np.maximum(3.0 * priors.yaw_sd_rad, 0.1)
    turn = complex(turns[near].mean()) if near.any() else complex(best)
    return complex(turn / abs(turn) * np.exp(-np.median(np.log(np.abs(shape)))))


def _by_pairs(place: Complexes, fixes: Fixes) -> list[complex]:
    """Turn and scale with the least median residual, of many pairs of fixes far apart; none of under 4."""
    n = len(place)
    count, drawn = n * (n - 1) // 2, 8 * SAMPLES
    if count <= SAMPLES:
        i, j = np.triu_indices(n, 1)
    else:
        i, j = _pairs_of(n, np.random.default_rng(0).choice(count, drawn, replace=count < drawn))
        far = np.argsort(-np.abs(place[i] - place[j]), kind="stable")[: len(i) // 2]
        far = far[:: max(1, len(far) // SAMPLES)]
        i, j = i[far], j[far]
    base, given = place[i] - place[j], fixes.at[i] - fixes.at[j]
    apart = (np.abs(base) > 0.0) & (np.abs(given) > 0.0)
    if n < 4 or not apart.any():
        return []
    whole = given[apart] / base[apart]
    left = fixes.at[None] - whole[:, None] * place[None]
    shift = np.median(left.real, axis=1) + 1j * np.median(left.imag, axis=1)
    return [complex(whole[np.median(np.abs(left - shift[:, None]), axis=1).argmin()])]


def _pairs_of(n: int, numbers: Ints) -> tuple[Ints, Ints]:
    """The pairs of n with these numbers in the order of `np.triu_indices(n, 1)`."""
    i = ((2 * n - 1 - np.sqrt((2.0 * n - 1.0) ** 2 - 8.0 * numbers)) // 2).astype(np.intp)
    return i, numbers - i * (2 * n - i - 1) // 2 + i + 1


def _improved(
    whole: complex, place: Complexes, given: complex, sd: tuple[float, float], fixes: Fixes
) -> tuple[float, complex, complex, Floats]:
    """Cost, similarity and weights after re-weighting; sd: of the scale and turn `given`."""
    left = fixes.at - whole * place
    shift = complex(np.median(left.real), np.median(left.imag))
    design, weight = np.concatenate(similarity_design(place)), np.ones(len(place))
    for _ in range(20):
        standard = np.abs(fixes.at - whole * place - shift) / fixes.sd_m
        noise = max(float(np.median(standard)) / MEDIAN_LENGTH, LEAST_NOISE)
        weight = redescending_weight(standard / noise)
        root = np.sqrt(weight) / (noise * fixes.sd_m)
        axis, off = whole / abs(whole), float(np.angle(whole / given))
        by_turn = np.sqrt(float(redescending_weight(np.array(abs(off) / sd[1])))) / sd[1]
        prior = np.array([[axis.real, axis.imag, 0, 0], [-axis.imag, axis.real, 0, 0]])
        prior *= [[1.0 / (sd[0] * abs(given))], [by_turn / abs(whole)]]
        rows = np.concatenate([design * np.tile(root, 2)[:, None], prior])
        sides = np.concatenate([fixes.at.real * root, fixes.at.imag * root, [1.0 / sd[0], -off * by_turn]])
        size = np.linalg.norm(rows, axis=0) + 1e-12
        x = least_squares(rows / size, sides, rcond=1e-12) / size
        whole, shift = complex(x[0], x[1]), complex(x[2], x[3])
    standard = np.abs(fixes.at - whole * place - shift) / fixes.sd_m
    scale, turn = np.log(abs(whole / given)) / sd[0], np.angle(whole / given) / sd[1]
    cost = float(np.log1p(standard**2).sum() + np.log1p(scale**2) + np.log1p(turn**2))
    return cost, whole, shift, weight
