"""Resection of frames with wrong poses, from ground points of other frames: an oblique view of flat ground
has two similar poses, of which a nadir start may lead to the wrong one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.arrays import Bools, Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned

LEAST_COUNTED = sourced(0.5, "of the observations", "with weight; wrong, blurred frames: less", "60 surveys")
_COUNTS = tuned(0.5, "share of a full weight", "more is no blunder")
_OTHERS = sourced(2, "frames", "with weight for a point, without the frame itself", "rays meet from two on")
_LEAST_POINTS = tuned(12, "points", "that agree on a pose; four determine one, so many hardly by chance")
_WITHIN_PX = tuned(8.0, "px", "residual of a point that agrees; rolling shutters take some")
_BETTER = tuned(0.5, "of the median residual", "most of the new pose; less sure ones are not taken")
_TRIALS = sourced(1000, "samples of five", "with 1/3 of good points", "Fischler 1981: 1 - (1 - 3^-5)^1000")
_SURE = sourced(0.984, "probability", "of a good sample, when fewer will do", "as of _TRIALS")
_DOWNWARDS = np.diag([1.0, -1.0, -1.0])
"""From camera axes with z backwards to OpenCV's with z forwards."""


def counted_shares(tracks: Tracks, bundle: Solution, frames: int) -> Floats:
    """Share of each frame's observations that count, (n,); NaN without any."""
    counts = np.bincount(tracks.frame, bundle.weight[: len(tracks.frame)] > _COUNTS, minlength=frames)
    with np.errstate(invalid="ignore"):
        return np.asarray(counts / np.bincount(tracks.frame, minlength=frames))


def resected(tracks: Tracks, bundle: Solution, cameras: Sequence[Camera], wrong: Bools) -> Poses | None:
    """The bundle's poses with frames resected from points of at least two other frames; None where none is
    better than before. Random samples, then a quadratic programme of all points that agree (SQPnP, Terzakis
    and Lourakis 2020), which finds the better of two poses over a plane. Args: cameras: of each frame; wrong
    (n,): frames to resect."""
    counts = (bundle.weight > _COUNTS) & ~wrong[tracks.frame]
    sure = np.bincount(tracks.point, counts, minlength=tracks.points) >= _OTHERS
    positions, rotations, found = bundle.poses.positions_m.copy(), bundle.poses.rotations.copy(), False
    for i in np.flatnonzero(wrong).tolist():
        mine = np.flatnonzero((tracks.frame == i) & sure[tracks.point])
        if len(mine) < _LEAST_POINTS:
            continue
        ground_m, image_px = bundle.points_m[tracks.point[mine]], tracks.image_px[mine]
        pose = _pose(ground_m, image_px, cameras[i])
        if pose is None:
            continue
        off_px = cameras[i].image_from_camera((ground_m - pose[0]) @ pose[1]) - image_px
        now, before = (np.linalg.norm(off, axis=1) for off in (off_px, bundle.residual_px[mine]))
        now, before = (np.median(np.nan_to_num(length, nan=np.inf)) for length in (now, before))
        if now < _BETTER * before:
            positions[i], rotations[i], found = *pose, True
    return replace(bundle.poses, positions_m=positions, rotations=rotations) if found else None


def _pose(ground_m: Floats, image_px: Floats, camera: Camera) -> tuple[Floats, Floats] | None:
    """Position (3,) in m and rotation (3, 3), if enough points agree with them."""
    ray = camera.ray_from_image(image_px) @ _DOWNWARDS
    middle, hit = ground_m.mean(axis=0), np.isfinite(ray).all(axis=1)
    if hit.sum() < _LEAST_POINTS:
        return None
    try:
        done, turn, shift, agree = cv2.solvePnPRansac(
            ground_m[hit] - middle,
            ray[hit, :2],
            np.eye(3),
            None,
            iterationsCount=_TRIALS,
            reprojectionError=_WITHIN_PX / camera.focal_length_px,
            confidence=_SURE,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:  # ground points at one place
        return None
    if not done or agree is None or len(agree) < _LEAST_POINTS:
        return None
    from_ground = np.array(cv2.Rodrigues(turn)[0], dtype=np.float64)
    return middle - from_ground.T @ np.array(shift, dtype=np.float64).ravel(), from_ground.T @ _DOWNWARDS
