"""What the residuals say of the deviations that were stated, and of what the block determines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.bundle_equations import (
    lengths_px,
    normals_of,
    pose_sd,
    present_miss,
    shared_sd,
    trust_of,
)
from geomosaic.adjustment.bundle_model import MEASURED_SD_PX, Priors, State
from geomosaic.adjustment.normal import reduce_normals
from geomosaic.adjustment.robust import cauchy_weight, lie_weight
from geomosaic.adjustment.terrain import surface_share
from geomosaic.adjustment.tracks import Tracks

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
_LEAST_SIGMA_PX = 0.02
_DETERMINED = 0.7
_ERRORS_ALIKE = 5.0
_PRIOR_FACTORS = (0.1, 10.0)
_MEDIAN_LENGTH = float(np.sqrt(np.log(4.0)))  # of residuals (2,) with a deviation of 1 each


def variance_components(
    tracks: Tracks,
    camera_of: Ints,
    priors: Priors,
    state: State,
    sigma: dict[str, float],
    *,
    image_only: bool,
) -> tuple[float, float]:
    """Updates the groups' factors in place; returns the relative change of the image's factor and the
    largest of the priors'. The priors' factors wait until the image's has settled: before, they would
    take up what the poses haven't yet."""
    n = normals_of(tracks, camera_of, priors, state, sigma)
    reduced = reduce_normals(n)
    covariance, shared = reduced.covariance()
    miss, sd = present_miss(priors, state), pose_sd(priors, sigma)
    weight = trust_of(priors)
    share = np.diagonal(covariance, axis1=1, axis2=2) * weight / sd**2
    control = priors.control[tracks.point]
    length_px = lengths_px(tracks, camera_of, priors, state)
    before = sigma["image"], sigma["control"]
    if not control.all():
        length = np.nan_to_num(length_px[~control] / sigma["image"], nan=1e6)
        robust = cauchy_weight(length)
        settled = float(share.sum()) + surface_share(n, reduced.points_inverse)
        known = np.diag(shared)[: state.interior.size] / shared_sd(priors)[: state.interior.size] ** 2
        settled += float(known.sum())
        unknowns = 6 * len(state.positions) + state.interior.size + 3 * int((~priors.control).sum()) - settled
        redundancy = max(2.0 * float(robust.sum()) - unknowns, 1.0)
        sigma["image"] *= float(np.sqrt((robust * length**2).sum() / redundancy))
        sigma["image"] = max(sigma["image"], _LEAST_SIGMA_PX)
    sigma["control"] = max(MEASURED_SD_PX, median_px(length_px[control]) / _MEDIAN_LENGTH)
    after = sigma["image"], sigma["control"]
    image_changed = float(np.abs(np.log(np.divide(after, before))).max())
    if image_only:
        return image_changed, 0.0
    changes = [0.0]
    for group, columns in (("horizontal", [0, 1]), ("vertical", [2]), ("tilt", [3, 4]), ("yaw", [5])):
        known = np.asarray(np.isfinite(sd[:, columns]))
        r = float((weight[:, columns] - share[:, columns])[known].sum())
        if r < 3.0:
            continue
        total = float((weight[:, columns] * (miss[:, columns] / sd[:, columns]) ** 2)[known].sum())
        factor = sigma[group]
        sigma[group] = float(np.clip(_believed(factor * np.sqrt(total / r), r), *_PRIOR_FACTORS))
        changes.append(float(abs(np.log(sigma[group] / factor))))
    return image_changed, max(changes)


def _believed(factor: float, redundancy: float) -> float:
    """A factor estimated from so many redundant observations, drawn to 1 where it may as well be chance.

    Its logarithm is weighed with the probability that the stated deviation is wrong, by Schwarz's
    approximation (1978) of the evidence: of 48 observations a factor of 1.1 is chance, one of 1.5 is not.
    Else the covariance of a small block with rightly stated deviations would follow their draw.
    """
    variance = max(factor**2, 1e-6)
    evidence = redundancy / 2.0 * (variance - 1.0 - np.log(variance))
    wrong = 1.0 / (1.0 + np.sqrt(redundancy) * np.exp(-min(evidence, 500.0)))
    return float(np.exp(wrong * np.log(variance) / 2.0))


def trust_in_tags(priors: Priors, state: State, sigma: dict[str, float]) -> Floats:
    """Weights of each frame's position and attitude, (f, 6): a wild tag loses its say.

    A frame is wild against the bulk of the others, never all at once: else a whole block that shrinks
    or tips over would free itself from its positions.
    """
    miss = present_miss(priors, state) / pose_sd(priors, sigma)
    length = np.sqrt(np.add.reduceat(miss**2, [0, 3], axis=1))
    bulk = np.maximum(1.0, np.median(length, axis=0) / 1.5)
    return np.repeat(lie_weight(length / bulk), 3, axis=1)


def undetermined(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, sigma: dict[str, float]
) -> Bools:
    """Which shared unknowns the block does not determine, (s,): worst first, until all others are.

    Keypoints err alike along a track and from neighbour to neighbour, so that the redundancy of many tracks
    is not what it seems. A number counts as determined if with image errors _ERRORS_ALIKE times as large its
    deviation would still be below _DETERMINED of what it was before pictures and POS spoke.
    """
    sd = np.concatenate([priors.interior_sd.ravel(), priors.mounting.sd])
    wider = sigma | {"image": _ERRORS_ALIKE * sigma["image"]}
    normals = normals_of(tracks, camera_of, replace(priors, held=None), state, wider)
    shared = np.delete(reduce_normals(normals).shared_covariance(), priors.interior_sd.size, axis=0)
    shared = np.delete(shared, priors.interior_sd.size, axis=1)
    free = np.flatnonzero(sd[: len(shared)] > 0.0)
    covariance = shared[np.ix_(free, free)] / np.outer(sd[free], sd[free])
    told = np.linalg.inv(covariance) - np.eye(len(free))
    out, left = np.zeros(sd.size, dtype=bool), np.arange(len(free))
    while left.size:
        share = np.sqrt(np.diag(np.linalg.inv(told[np.ix_(left, left)] + np.eye(left.size))))
        worst = int(share.argmax())
        if share[worst] < _DETERMINED:
            break
        out[free[left[worst]]] = True
        left = np.delete(left, worst)
    return out


def median_px(lengths_px: Floats) -> float:
    """Median of what is known, else 0."""
    known = lengths_px[np.isfinite(lengths_px)]
    return float(np.median(known)) if known.size else 0.0
