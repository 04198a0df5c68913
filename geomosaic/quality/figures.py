"""The figures a mosaic is judged by, from displacement vectors against a reference."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from geomosaic.arrays import Floats, Ints64


@dataclass(frozen=True)
class Similarity:
    """Map coordinates in the mosaic from those in the reference: one scale, one turn, one shift.

    `mosaic = centre + shift + scale * R(rotation) (reference - centre)`; rotation is counter-clockwise
    (from east to north), centre the mean of the patches' positions.
    """

    scale: float
    rotation_rad: float
    shift_east_m: float
    shift_north_m: float
    centre_east_m: float
    centre_north_m: float


@dataclass(frozen=True)
class Figures:
    """What the vectors say. All lengths are of two-dimensional vectors; NaN where too few were measured.

    asked, measured, share_measured: patches valid in both images; those matched; their ratio.
    mean_east_m, mean_north_m: mean displacement, mosaic minus reference.
    absolute_rmse_m: root of the mean squared length of the displacements.
    ce90_m: 90 % of the displacements are shorter (circular error, empirical).
    similarity: best in least squares over all vectors; needs 3 or more.
    after_similarity_m, after_similarity_px: RMSE of what the similarity leaves: the block in itself.
    jump_99_px: 99 % of the differences between the vectors of touching patches are shorter than this;
    jump_rms_px their root mean square. Patches touch when their centres are one patch apart along a row or
    a col, so that the figure depends on the patch but not on the step. The vectors are those that the
    similarity leaves: a mosaic that is turned or scaled as a whole has no seams. A seam shows here.
    """

    asked: int
    measured: int
    share_measured: float
    mean_east_m: float
    mean_north_m: float
    absolute_rmse_m: float
    ce90_m: float
    similarity: Similarity
    after_similarity_m: float
    after_similarity_px: float
    jump_99_px: float
    jump_rms_px: float


def circle_of(share: float) -> float:
    """Radius, in horizontal RMSE, of the circle that holds a share of normal errors, equal east and north
    (Rayleigh's distribution; NSSDA, FGDC-STD-007.3)."""
    return math.sqrt(-math.log1p(-share))


def interval_of(share: float) -> float:
    """Half of the interval, in deviations, that holds a share of normal errors."""
    return NormalDist().inv_cdf((1.0 + share) / 2.0)


def best_similarity(at_m: Floats, displacement_m: Floats) -> tuple[Similarity, Floats]:
    """The similarity that explains the displacements best, and what it leaves, (n, 2).

    Least squares in closed form: with complex positions z and displaced positions z' about their means,
    the factor is `sum(conj(z) z') / sum(|z|^2)`. All NaN for fewer than 3 vectors.

    Args: at_m (n, 2) east and north in the reference, displacement_m (n, 2).
    """
    if len(at_m) < 3:
        nan = float("nan")
        return Similarity(nan, nan, nan, nan, nan, nan), np.full((len(at_m), 2), np.nan)
    centre, shift = at_m.mean(axis=0), displacement_m.mean(axis=0)
    z = (at_m - centre) @ [1.0, 1.0j]
    moved = z + (displacement_m - shift) @ [1.0, 1.0j]
    factor = np.vdot(z, moved) / np.vdot(z, z).real
    left = moved - factor * z
    similarity = Similarity(
        float(abs(factor)), float(np.angle(factor)), *map(float, shift), *map(float, centre)
    )
    return similarity, np.stack([left.real, left.imag], axis=-1)


def touching_patches(centres_px: Floats, patch_px: int, step_px: int) -> Ints64:
    """Pairs (k, 2) of indices of patches whose centres are one patch apart along a row or a col.

    Where the step doesn't divide the patch, the next whole number of steps that clears it.
    """
    if not len(centres_px):
        return np.empty((0, 2), dtype=np.int64)
    cell = np.rint((centres_px - centres_px.min(axis=0)) / step_px).astype(np.int64)
    grid = np.full(cell.max(axis=0) + 1, -1, dtype=np.int64)
    grid[cell[:, 0], cell[:, 1]] = np.arange(len(cell))
    apart = -(-patch_px // step_px)
    pairs = [
        np.stack([grid[:-apart].ravel(), grid[apart:].ravel()], axis=-1),
        np.stack([grid[:, :-apart].ravel(), grid[:, apart:].ravel()], axis=-1),
    ]
    both = np.concatenate(pairs)
    return both[(both >= 0).all(axis=1)]


def figures(at_m: Floats, displacement_m: Floats, touching: Ints64, gsd_m: float, asked: int) -> Figures:
    """All figures of n vectors.

    Args: at_m, displacement_m (n, 2) east and north; touching (k, 2) indices (`touching_patches`);
    gsd_m side of the mosaic's pixel; asked number of patches tried.
    """
    similarity, left_m = best_similarity(at_m, displacement_m)
    length_m = np.linalg.norm(displacement_m, axis=1)
    jumps_px = np.linalg.norm(left_m[touching[:, 0]] - left_m[touching[:, 1]], axis=1) / gsd_m
    after_m = _root_mean_square(np.linalg.norm(left_m, axis=1))
    mean = displacement_m.mean(axis=0) if len(at_m) else np.full(2, np.nan)
    return Figures(
        asked=asked,
        measured=len(at_m),
        share_measured=len(at_m) / asked if asked else 0.0,
        mean_east_m=float(mean[0]),
        mean_north_m=float(mean[1]),
        absolute_rmse_m=_root_mean_square(length_m),
        ce90_m=_quantile(length_m, 0.9),
        similarity=similarity,
        after_similarity_m=after_m,
        after_similarity_px=after_m / gsd_m,
        jump_99_px=_quantile(jumps_px, 0.99),
        jump_rms_px=_root_mean_square(jumps_px),
    )


def _root_mean_square(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _quantile(values: Floats, q: float) -> float:
    return float(np.quantile(values, q)) if values.size else float("nan")
