"""How near points may come to the cameras that see them."""

from __future__ import annotations

import numpy as np

from geomosaic.adjustment.problem.tracks import Tracks, frame_by_frame
from geomosaic.arrays import Floats, Ints
from geomosaic.constants import tuned

_NEAREST = tuned(0.05, "share of a frame's usual distance to its points", "more: tall trees are held down")


def clearances_m(tracks: Tracks, positions_m: Floats, points_m: Floats) -> Floats:
    """The least distance of each frame's points, (f,), by where they are; 0 for a frame that sees none."""
    out = np.zeros(len(positions_m))
    for i, mine in frame_by_frame(tracks.frame):
        away = points_m[tracks.point[mine]] - positions_m[i]
        out[i] = _NEAREST * float(np.median(np.linalg.norm(away, axis=1)))
    return out


def too_near(tracks: Tracks, clearance_m: Floats, positions_m: Floats, points_m: Floats) -> Ints:
    """Points that lie nearer to a camera that sees them."""
    square_m2, near = np.zeros(len(tracks.frame)), np.square(clearance_m)[tracks.frame]
    for points, positions in zip(points_m.T, positions_m.T, strict=True):
        square_m2 += np.square(points[tracks.point] - positions[tracks.frame])
    return np.unique(tracks.point[square_m2 < near])
