"""A frame's pose from ground points that others have found: a way out where a solution has begun wrongly.

Flat ground seen aslant has two poses that look alike. A frame of which nothing is known begins by looking
down, and may end at the wrong one, with most of its tie points put aside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
UNHEARD = sourced(
    0.5,
    "share of a frame's image observations",
    "with more than half of their weight: of frames that fit, three quarters have it; of those that lie "
    "wrongly, and of blurred ones, a tenth to not half",
    "60 simulated surveys: least share of 0.62 among sharp frames at their places, but one",
)
_HEARD = tuned(0.5, "share of a full weight", "what counts more isn't put aside")
_OTHERS = sourced(
    2,
    "frames",
    "whose observations of a point are heard, beside the frame's own: fewer don't find a point",
    "rays meet from two on",
)
_LEAST_POINTS = tuned(
    12,
    "points",
    "that agree on a pose: four determine one, and so many hardly agree by chance",
)
_WITHIN_PX = tuned(
    8.0,
    "px",
    "that a point may miss by: rows that are read one after the other miss by some; the bundle that "
    "follows finds the rest",
)
_BETTER = tuned(0.5, "of the median miss", "that the new pose may leave: less sure ones stay where they are")
_TRIALS = sourced(
    1000,
    "samples",
    "of five points: with a third of them right, one sample in 243 is; with so many few are missed",
    "Fischler and Bolles 1981: 1 - (1 - 1/243)^1000 = 0.984",
)
_SURE = sourced(0.984, "probability", "that a sample was right, when fewer will do", "as of _TRIALS")
_DOWNWARDS = np.diag([1.0, -1.0, -1.0])
"""From camera axes with z backwards to those of OpenCV, with z forwards."""


def heard_shares(tracks: Tracks, bundle: Solution, frames: int) -> Floats:
    """Of each frame's observations those that count, (n,); NaN without any."""
    heard = np.bincount(tracks.frame, bundle.weight[: len(tracks.frame)] > _HEARD, minlength=frames)
    with np.errstate(invalid="ignore"):
        return np.asarray(heard / np.bincount(tracks.frame, minlength=frames))


def resected(tracks: Tracks, bundle: Solution, cameras: Sequence[Camera], wrong: Bools) -> Poses | None:
    """The bundle's poses with those of some frames found anew, by the points that two other frames and more
    agree on; None where none is better than it was. wrong (n,): which to look at; cameras: of each frame.

    Samples of five points, then a quadratic programme of all that agree (Terzakis and Lourakis 2020, SQPnP;
    of those in `cv2.solvePnPRansac` it finds the better of two poses over a plane).
    """
    heard = (bundle.weight > _HEARD) & ~wrong[tracks.frame]
    sure = np.bincount(tracks.point, heard, minlength=tracks.points) >= _OTHERS
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
        now, before = (_median_px(off) for off in (off_px, bundle.residual_px[mine]))
        if now < _BETTER * before:
            positions[i], rotations[i], found = *pose, True
    return replace(bundle.poses, positions_m=positions, rotations=rotations) if found else None


def _median_px(off_px: Floats) -> float:
    return float(np.median(np.nan_to_num(np.linalg.norm(off_px, axis=1), nan=np.inf)))


def _pose(ground_m: Floats, image_px: Floats, camera: Camera) -> tuple[Floats, Floats] | None:
    """Position and rotation, if enough points agree with them."""
    ray = camera.ray_from_image(image_px) @ _DOWNWARDS
    middle = ground_m.mean(axis=0)
    seen = np.isfinite(ray).all(axis=1)
    if seen.sum() < _LEAST_POINTS:
        return None
    try:
        done, turn, shift, agree = cv2.solvePnPRansac(
            ground_m[seen] - middle,
            ray[seen, :2],
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
    shift_m = np.array(shift, dtype=np.float64).ravel()
    return middle - from_ground.T @ shift_m, from_ground.T @ _DOWNWARDS
