"""What an adjustment says of frames and of pairs, as columns whose names end in units."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomosaic.adjustment.model import Adjusted, ImageResiduals
from geomosaic.arrays import Complexes, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import Rotation
from geomosaic.constants import tuned
from geomosaic.matching.model import TiePairs, TiePoints
from geomosaic.matching.tracks import Tracks, nearest_to_rays
from geomosaic.projection.footprint import ground_from_images
from geomosaic.quality.misalignment import pair_misalignments

DOWN_WEIGHTED = tuned(0.5, "full weight", "below, a tie point counts as down-weighted")
SAMPLED_TIES = tuned(4000, "tie points", "shown in a plan, 100 KB: fewer hide where the ground has none")


def tie_weights(ties: TiePoints, image: ImageResiduals | None) -> tuple[Floats, ...]:
    """The solve's weight of each tie point of each pair, (k,): the lesser of both sides'; NaN for those that
    took no part in it."""
    if image is None or not len(image.frame):
        return tuple(np.full(len(t), np.nan) for t in ties.pairs)
    order = np.lexsort((*image.image_px.T[::-1], image.frame))
    frames, marks, weights = image.frame[order], _marks(image.image_px[order]), image.weight[order]
    pairs = TiePairs.of(ties.pairs)
    own, weight = _marks(pairs.image_px), np.empty(len(pairs.frame))
    changes = np.flatnonzero(np.diff(pairs.frame)) + 1
    for mine in np.split(np.arange(len(own)), changes) if len(own) else ():
        first, end = np.searchsorted(frames, pairs.frame[mine[0]] + np.arange(2))
        at = np.minimum(first + np.searchsorted(marks[first:end], own[mine]), len(marks) - 1)
        weight[mine] = np.where(marks[at] == own[mine], weights[at], np.nan)
    lesser = np.fmin(*weight[pairs.keypoints])
    return tuple(np.split(lesser, pairs.first[1:-1])) if len(pairs) else ()


def _marks(px: Floats) -> Complexes:
    """One number for each observation (k, 2) of a frame, in the order of cols, then rows."""
    return np.ascontiguousarray(px, np.float64).view(np.complex128)[:, 0]


def pose_columns(poses: Poses) -> dict[str, Floats]:
    """Where frames are in the work frame and how they look, as a body's angles: pitch 0 looks down."""
    angles = np.degrees(np.stack(Rotation(poses.rotations).yaw_pitch_roll()))
    sd_deg = np.degrees(poses.rotations_sd_rad)
    return {
        **dict(zip(("east_m", "north_m", "up_m"), poses.positions_m.T, strict=True)),
        **dict(zip(("yaw_deg", "pitch_deg", "roll_deg"), (angles[0] % 360.0, *angles[1:]), strict=True)),
        **dict(zip(("sd_e_m", "sd_n_m", "sd_u_m"), poses.positions_sd_m.T, strict=True)),
        "sd_tilt_deg": sd_deg[:, :2].max(axis=1),
        "sd_yaw_deg": sd_deg[:, 2],
    }


def move_columns(prior: Poses, adjusted: Adjusted, ties: TiePoints) -> dict[str, Floats]:
    """How far frames moved and turned, and what ties them."""
    n = len(adjusted.status)
    moved = adjusted.poses.positions_m - prior.positions_m
    turn = np.swapaxes(prior.rotations, 1, 2) @ adjusted.poses.rotations
    cosine = (np.trace(turn, axis1=1, axis2=2) - 1.0) / 2.0
    ends = np.array(ties.frames, dtype=np.intp).reshape(-1, 2)
    points = np.repeat([len(t) for t in ties.pairs], 2)
    image = adjusted.image_residuals
    down = np.full(n, np.nan)
    if image is not None and len(image.frame):
        seen = np.bincount(image.frame, minlength=n)
        down_weighted = np.bincount(image.frame, image.weight < DOWN_WEIGHTED, minlength=n)
        down = np.where(seen > 0, down_weighted / np.maximum(seen, 1), np.nan)
    return {
        **dict(zip(("moved_e_m", "moved_n_m", "moved_u_m"), moved.T, strict=True)),
        "turned_deg": np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))),
        "pairs": np.bincount(ends.ravel(), minlength=n).astype(np.float64),
        "tie_points": np.bincount(ends.ravel(), points, minlength=n).astype(np.float64),
        "share_down_weighted": down,
    }


def pair_columns(
    ties: TiePoints, residuals_m: Sequence[Floats], weights: Sequence[Floats]
) -> dict[str, Floats]:
    """Of each tied pair its residuals on the ground, right minus left."""
    of = pair_misalignments(ties, residuals_m)
    lengths = [np.linalg.norm(r, axis=1) for r in residuals_m]
    taken = [w[np.isfinite(w)] for w in weights]
    return {
        "tie_points": of.points.astype(np.float64),
        "mean_e_m": of.mean_m[:, 0],
        "mean_n_m": of.mean_m[:, 1],
        "rms_m": of.rms_m,
        "median_m": np.array([np.median(x) if x.size else np.nan for x in lengths]),
        "largest_m": of.max_m,
        "share_down_weighted": np.array([(w < DOWN_WEIGHTED).mean() if w.size else np.nan for w in taken]),
    }


def sampled_ties(
    ties: TiePoints, adjusted: Adjusted, most: int = SAMPLED_TIES
) -> tuple[Ints, Ints, Floats, dict[str, Floats]]:
    """Left and right frame (k,) of about `most` tie points, spread evenly over all, the points (k, 3) where
    their two rays meet, and columns. The columns are where the left frame has them on the ground, and their
    residuals."""
    count = [len(t) for t in ties.pairs]
    taken = np.arange(0, sum(count), max(1, sum(count) // most))
    pair = np.searchsorted(np.cumsum(count), taken, side="right")
    ends = np.array(ties.frames, dtype=np.intp).reshape(-1, 2)[pair]
    left, right = ends.T
    px, right_px = (
        np.concatenate([np.zeros((0, 2)), *(getattr(t, side) for t in ties.pairs)])[taken]
        for side in ("left_px", "right_px")
    )
    residual = np.concatenate([np.zeros((0, 2)), *adjusted.residuals_m])[taken]
    at = ground_from_images(left, px, adjusted.poses, adjusted.cameras, adjusted.ground)
    both = Tracks(ends.ravel(), np.repeat(np.arange(len(taken)), 2), np.hstack([px, right_px]).reshape(-1, 2))
    met = nearest_to_rays(both, adjusted.poses, adjusted.cameras, at) if len(taken) else at
    return left, right, met, {"east_m": at[:, 0], "north_m": at[:, 1], "residual_m": np.hypot(*residual.T)}
