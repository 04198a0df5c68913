"""What the residuals say of the deviations that were stated, and of what the block determines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.problem.bundle_model import GROUPS, MEASURED_SD_PX, Factors, Priors, State
from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.solver.bundle_equations import (
    has_say,
    lengths_px,
    longest_side_px,
    normals_of,
    pose_sd,
    present_miss,
    share_shown,
    shared_sd,
    trust_of,
    unrest_of,
    while_read,
    while_read_sd,
)
from geomosaic.adjustment.solver.normal_equations import Reduced, reduce_normals
from geomosaic.adjustment.solver.prior_reweighting import median_px, observed_of, own_miss, parts_of
from geomosaic.adjustment.terms.control_precision import control_component
from geomosaic.adjustment.terms.rolling_shutter_rotation import MOST_DRIFT
from geomosaic.adjustment.terms.terrain import surface_share
from geomosaic.constants import MEDIAN_LENGTH, sourced, tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.linear import inverse
from geomosaic.estimation.robust import INFORMATION, credible, student_weight

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
_LEAST_SIGMA_PX = tuned(
    0.02,
    "px",
    "deviation of image coordinates at least: with 0, exact tie points (simulated ones) would weigh "
    "without bound; keypoints of clean images are off by 0.1 px, five times as much",
)
_DETERMINED = tuned(
    0.7,
    "share of the deviation before",
    "below which a shared unknown counts as determined, half of its variance being taken away: with "
    "more, what images hardly show goes astray; with less, what they show is held as it was given",
)
_ERRORS_ALIKE = tuned(
    5.0,
    "times the image deviation",
    "with which an unknown still has to be determined, since keypoints err alike from neighbour to "
    "neighbour. Left free, a real nadir flight's focal length went 9 % off; with more, lenses that are "
    "determined would be held",
)
_INFORMATIVE = sourced(
    600,
    "image observations a frame",
    "beyond which more show nothing new of what all frames share: with all of 30,000 tie points a focal "
    "length looked determined to 2 px and was 75 px off; with 192 a lens's second term was held and a "
    "block 0.10 px off instead of 0.02",
    "docs/results.md, surveys as people deliver them: seeds 4 and 5 of 1 to 10",
)
PRIOR_FACTORS: tuple[float, float] = tuned(
    (0.1, 10.0),
    "times the stated deviation",
    "least and largest: EXIF's positions, which state nothing, count as good to 5 m and may be RTK's or "
    "a car's; deviations that are stated in the wrong unit or for 1 of 3 axes are off by less than ten. "
    "Beyond, the tags are not what they say",
)
LEAST_SWING = tuned(
    0.02,
    "times the deviation to begin with",
    "a copter's good mount leaves a twentieth of a small wing in gusts; with less, swings could not grow "
    "again",
)
_LEAST_REDUNDANCY = tuned(
    3.0,
    "redundant observations",
    "that a variance component needs; of fewer its estimate is chance, and what was stated stands",
)
_COMMON: dict[str, float] = sourced(
    {"horizontal": 4.0, "vertical": 1.0, "tilt": 0.0, "yaw": 1.0},
    "unknowns",
    "that the frames of a part have in common, taken off the redundancy as their miss is (see "
    "`own_miss`): place, turn and scale; height; of tilts nothing; heading",
    "degrees of freedom: 4 of a similarity of the plane, 1 of a height, 1 of a heading",
)
_OF_SLOPE = sourced(
    2.0,
    "unknowns",
    "more of a part whose heights miss by a slope",
    "degrees of freedom of a slope",
)
_STIFF = sourced(
    0.03,
    "of the largest axis's deviation",
    "below which an axis is held: a tilt of some degrees brings more of the others into it than it has",
    "between 1 and swing.LEVEL_AXES",
)
_A_LITTLE = tuned(1.01, "times a factor", "by which another is told what it follows: a slope, by difference")
_SCALINGS = tuned(
    12,
    "rounds",
    "each of which halves what a scale is off by: they leave one part in 4000, with fewer the steps "
    "that follow are weighed by a scale that has not settled",
)


def variance_components(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    state: State,
    factors: Factors,
    reduced: Reduced,
    *,
    image_only: bool,
) -> tuple[Factors, Floats]:
    """The factors that residuals and redundancy speak for; and by how much the logarithm of each that is
    found of the priors' groups and the swings follows that of each that it was found with, (g, g).

    The priors' wait until the image's has settled: before, they would take up what the poses haven't yet.
    What all frames of a part miss in common (its place, turn and scale, its height, its heading) says nothing
    of the deviation of one: else a block at a wrong scale would excuse itself.

    Args: reduced: the equations of the step that led here; redundancies are theirs.
    """
    covariance, shared = reduced.covariance()
    sd, weight = pose_sd(priors, factors), trust_of(priors)
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    share = variances[:, :6] * weight / sd**2
    control, most_px = priors.control[tracks.point], longest_side_px(priors)
    length_px = lengths_px(tracks, camera_of, priors, state)
    of_reading = while_read_sd(priors, factors)
    tied = ~control & has_say(tracks, priors)
    if tied.any():
        shown = share_shown(tracks, priors)[tied]
        settled = float(share.sum()) + surface_share(reduced.normals, reduced.points_inverse)
        known = np.diag(shared)[: state.interior.size] / shared_sd(priors)[: state.interior.size] ** 2
        settled += float(known.sum())
        settled += float((variances[:, 6:] / of_reading**2).sum())
        unknowns = reduced.pose_side.size + state.interior.size + 3 * int((~priors.control).sum()) - settled
        redundancy = max(2.0 * int(tied.sum()) - unknowns, 1.0)
        error_px = length_px[tied] / np.sqrt(shown) / unrest_of(tracks, priors)[tied]
        image_px = _scale_px(error_px, shown, redundancy, factors.image_px)
        factors = replace(factors, image_px=float(np.clip(image_px, _LEAST_SIGMA_PX, most_px)))
    control_px = median_px(length_px[control]) / MEDIAN_LENGTH
    factors = replace(factors, control_px=float(np.clip(control_px, MEASURED_SD_PX, most_px)))
    factors = control_component(tracks, camera_of, priors, state, factors)
    if image_only:
        return factors, np.zeros((len(GROUPS) + len(factors.while_read),) * 2)
    found = [
        *_of_groups(priors, state, factors, share),
        *_of_reading(priors, state, factors, variances[:, 6:]),
    ]
    by_group = {group: its.factor for group, its in zip(GROUPS, found, strict=False)}
    in_rows = tuple(its.factor for its in found[len(GROUPS) :])
    information = np.concatenate([weight / sd**2, 1.0 / of_reading**2], axis=1)
    miss = np.concatenate([present_miss(priors, state), -while_read(state)], axis=1)
    followed = _followed(found, reduced, covariance, miss * information, information)
    return replace(factors, **by_group, while_read=in_rows), followed


@dataclass(frozen=True)
class _Found:
    """The factor of a component; counted (f, d): how much each number of the frames counts for it; miss
    (f, d): what is left of each; squares, redundancy: of all of them; follows: by how much its logarithm
    follows that of the scatter, 0 where it stays."""

    factor: float
    counted: Floats
    miss: Floats
    squares: float = 1.0
    redundancy: float = 1.0
    follows: float = 0.0


def _followed(
    found: list[_Found], reduced: Reduced, covariance: Floats, pull: Floats, information: Floats
) -> Floats:
    """See `variance_components`: with another deviation of one component, unknowns go elsewhere, by the
    equations, and with them the squares of all; redundancies change by what each frame's own numbers have to
    do with each other.

    Args: covariance (f, d, d) of each frame; pull (f, d): of what was believed, by which information (f, d).
    """
    counted = np.stack([its.counted for its in found])
    of = counted > 0.0
    moved = 2.0 * reduced.responses(np.moveaxis(of * pull, 0, -1))
    kept = covariance * information[:, None, :]
    both = kept * np.swapaxes(kept, 1, 2)
    out = np.zeros((len(found), len(found)))
    for k, its in enumerate(found):
        if not its.follows:
            continue
        squares = 2.0 * np.einsum("fd,fdl->l", its.counted * its.miss * information, moved) / its.squares
        own = (of[k] * np.diagonal(kept, axis1=1, axis2=2)).sum()
        redundancy = -2.0 * np.einsum("fi,fij,lfj->l", of[k], both, of) / its.redundancy
        redundancy[k] += 2.0 * own / its.redundancy
        squares[k] -= 2.0
        out[k] = 0.5 * (squares - redundancy)
        out[k, k] += 1.0
        out[k] *= its.follows
    return out


def _of_groups(priors: Priors, state: State, factors: Factors, share: Floats) -> Iterator[_Found]:
    """Those of GROUPS; share (f, 6): of each number, what the images leave of its variance."""
    sd, weight = pose_sd(priors, factors), trust_of(priors)
    (miss, slopes), observed = own_miss(priors, state, factors), observed_of(priors)
    more = ((0, 0), (0, while_read(state).shape[1]))
    for group, columns in GROUPS.items():
        of_group = np.isin(np.arange(6), columns)
        stated: Bools = np.isfinite(sd) & observed & of_group
        counted = np.where(stated, weight, 0.0)
        in_all = np.where(observed & of_group, weight, 0.0).sum(axis=1)
        alone = float(sum(max(in_all[frames].sum() - _COMMON[group], 0.0) for frames in parts_of(priors)))
        alone -= _OF_SLOPE * slopes if group == "vertical" else 0.0
        r = min(float((counted - share)[stated].sum()), alone)
        told = np.pad(np.stack([counted, np.where(stated, miss, 0.0)]), ((0, 0), *more))
        if r < _LEAST_REDUNDANCY:
            yield _Found(factors.of(group), told[0], told[1])
            continue
        squares = float((counted * (miss / sd) ** 2)[stated].sum())
        scatter = factors.of(group) * float(np.sqrt(squares / r))
        factor, above = (credible(f, r) for f in (scatter, _A_LITTLE * scatter))
        least, most = PRIOR_FACTORS
        follows = float(np.log(above / factor) / np.log(_A_LITTLE)) if least < factor < most else 0.0
        factor = float(np.clip(factor, least, most))
        yield _Found(factor, told[0], told[1], squares, r, follows)


def limits_while_read(priors: Priors) -> tuple[Floats, Floats]:
    """Least and largest components of the swing's functions and, last, of drifts along the ground and up,
    (t + 2,) each. A gyroscope's zero is alike in all frames; until it is known swings don't shrink."""
    terms = 0 if priors.swing_sd_rad is None else priors.swing_sd_rad.shape[1]
    least = np.array([1.0 if priors.swing_common else LEAST_SWING] * terms + [LEAST_SWING] * 2)
    return least, np.array([priors.most_swing] * terms + [MOST_DRIFT] * 2)


def _of_reading(priors: Priors, state: State, factors: Factors, variances: Floats) -> Iterator[_Found]:
    """Of each function of the row, and of drifts along the ground and up, from all frames; less what all do
    alike in the camera's axes: that is the readout's or the lens's, not theirs."""
    if state.swing is None or state.drift_m is None:
        return
    own = np.concatenate([state.swing, state.drift_m[:, None]], axis=1)
    own = np.einsum("fji,ftj->fti", state.rotations, own)
    own = np.einsum("fij,ftj->fti", state.rotations, own - np.median(own, axis=0))
    terms, own = state.swing.shape[1], own.reshape(len(own), -1)
    sd = while_read_sd(priors, factors)
    of = np.append(np.repeat(np.arange(terms), 3), terms + np.array([0, 0, 1]))
    redundancy = 1.0 - variances / sd**2
    limits = limits_while_read(priors)
    for k, (factor, least, most) in enumerate(zip(factors.while_read, *limits, strict=True)):
        its = sd * (of == k)
        of_term = (its > _STIFF * its.max(axis=1, keepdims=True)).astype(float)
        told = np.pad(np.stack([of_term, -own]), ((0, 0), (0, 0), (6, 0)))
        r = float((of_term * redundancy).sum()) - (its.max(axis=0) > 0.0).sum()
        if r <= _LEAST_REDUNDANCY:
            yield _Found(float(np.clip(factor, least, most)), told[0], told[1])
            continue
        squares = float((of_term * (own / sd) ** 2).sum())
        scatter = factor * float(np.sqrt(squares / r))
        follows, scatter = float(least < scatter < most), float(np.clip(scatter, least, most))
        yield _Found(scatter, told[0], told[1], squares, r, follows)


def _scale_px(error_px: Floats, shown: Floats, redundancy: float, begun_px: float) -> float:
    """The scale of Student's distribution that errors of so much redundancy have; NaN are beyond all."""
    error_px, scale_px = np.nan_to_num(error_px, nan=1e6 * begun_px), begun_px
    for _ in range(_SCALINGS):
        error = error_px / scale_px
        squares = float((shown * student_weight(error) * error**2).sum()) / INFORMATION
        scale_px *= float(np.sqrt(squares / redundancy))
    return scale_px


def undetermined(tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors) -> Bools:
    """Which shared unknowns the block does not determine, (s,): worst first, until all others are.

    Keypoints err alike along a track and from neighbour to neighbour, so that the redundancy of many tracks
    is not what it seems: beyond _INFORMATIVE a frame, more of them show nothing new. A number counts as
    determined if with image errors _ERRORS_ALIKE times as large its deviation would still be below
    _DETERMINED of what it was before images and POS spoke. All of them count as not determined where their
    covariance is singular.
    """
    sd = np.concatenate([priors.interior_sd.ravel(), priors.mounting.sd])
    many = max(1.0, float(np.sqrt(len(tracks.frame) / (_INFORMATIVE * len(priors.poses)))))
    wider = replace(factors, image_px=_ERRORS_ALIKE * many * factors.image_px)
    normals = normals_of(tracks, camera_of, replace(priors, held=None), state, wider)
    shared = np.delete(reduce_normals(normals).shared_covariance(), priors.interior_sd.size, axis=0)
    shared = np.delete(shared, priors.interior_sd.size, axis=1)
    free = np.flatnonzero(sd[: len(shared)] > 0.0)
    covariance = shared[np.ix_(free, free)] / np.outer(sd[free], sd[free])
    try:
        shown = inverse(covariance) - np.eye(len(free))
    except NotSolvableError:
        return sd > 0.0
    out, left = np.zeros(sd.size, dtype=bool), np.arange(len(free))
    while left.size:
        share = np.sqrt(np.diag(inverse(shown[np.ix_(left, left)] + np.eye(left.size))))
        worst = int(share.argmax())
        if share[worst] < _DETERMINED:
            break
        out[free[left[worst]]] = True
        left = np.delete(left, worst)
    return out
