"""An adjusted block as structure from motion has it: cameras that look along z, points, tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Floats, Ints
from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import opencv_terms
from geomosaic.constants import tuned
from geomosaic.matching.model import TiePoints
from geomosaic.matching.tracks import (
    Tracks,
    chosen_tracks,
    frame_by_frame,
    join_tracks,
    nearest_to_rays,
    thin_tracks,
)
from geomosaic.projection.footprint import ground_from_image
from geomosaic.survey.model import Survey

_MOST_OFF_PX = tuned(4.0, "px", "RMS of a point's rays: more keeps mismatches; less loses trees in wind")
_MOST_A_FRAME = tuned(2_000, "points", "of a frame: more swell the file and change no dense cloud")
_DOWN_AND_FORWARD = np.diag([1.0, -1.0, -1.0])
"""From axes to the right, the image's top and against the view to those to the right, down and forward."""


@dataclass(frozen=True)
class SfmBlock:
    """A block in the survey's work frame: metres east, north and up about `Survey.work_frame`'s origin.

    frames (f,): their numbers in the survey, without rejected ones. rotations (f, 3, 3) and translations_m
    (f, 3): camera from work frame, `x_camera = R x + t`, with x right, y down, z forward. cameras: each once;
    camera (f,): which of them took each. points_m (p, 3), off_px (p,): root mean square by which their rays
    miss them. tracks: frames by their place here; image coordinates from the outer corner of the first pixel.
    """

    names: tuple[str, ...]
    frames: Ints
    rotations: Floats
    translations_m: Floats
    cameras: tuple[Camera, ...]
    camera: Ints
    points_m: Floats
    off_px: Floats
    tracks: Tracks


def sfm_block(survey: Survey, ties: TiePoints, adjusted: Adjusted) -> SfmBlock:
    """Frames that are tied or placed, and the points that their rays agree on."""
    kept = np.flatnonzero(np.array(adjusted.status) != "rejected")
    poses = adjusted.poses
    rotations = _DOWN_AND_FORWARD @ np.swapaxes(poses.rotations[kept], -1, -2)
    translations = -(rotations @ poses.positions_m[kept][:, :, None])[:, :, 0]
    lenses = {camera.name: camera for camera in adjusted.cameras}
    tracks = _among(join_tracks(ties), kept, len(poses))
    sizes = np.array([(camera.width_px, camera.height_px) for camera in adjusted.cameras], np.float64)
    tracks = thin_tracks(tracks, sizes.reshape(-1, 2), _MOST_A_FRAME)
    points_m, off_px = _located(tracks, adjusted)
    good = off_px < _MOST_OFF_PX
    tracks = chosen_tracks(tracks, good)
    return SfmBlock(
        tuple(survey.frames[i].name for i in kept),
        kept,
        rotations,
        translations,
        tuple(lenses.values()),
        np.array([list(lenses).index(adjusted.cameras[i].name) for i in kept], dtype=np.intp),
        points_m[good],
        off_px[good],
        Tracks(np.searchsorted(kept, tracks.frame), tracks.point, tracks.image_px),
    )


def _among(tracks: Tracks, kept: Ints, frames: int) -> Tracks:
    """Observations of frames that are kept, of points that two of them see."""
    seen = np.isin(np.arange(frames), kept)[tracks.frame]
    counts = np.bincount(tracks.point[seen], minlength=tracks.points)
    seen &= counts[tracks.point] >= 2
    point = np.unique(tracks.point[seen], return_inverse=True)[1]
    return Tracks(tracks.frame[seen], point, tracks.image_px[seen])


def _located(tracks: Tracks, adjusted: Adjusted) -> tuple[Floats, Floats]:
    """Where the rays of each point meet, and by how much they miss it there in their images.

    A point whose rays are all but parallel stays on the ground that the first of them meets; NaN where none
    meets any.
    """
    near_m, sum_sq = np.full((tracks.points, 3), np.nan), np.zeros(tracks.points)
    poses, cameras = adjusted.poses, adjusted.cameras
    by_frame = list(frame_by_frame(tracks.frame))
    for i, mine in reversed(by_frame):
        met = ground_from_image(poses[i], cameras[i], adjusted.ground, tracks.image_px[mine])
        there = np.isfinite(met).all(axis=1)
        near_m[tracks.point[mine][there]] = met[there]
    points_m = nearest_to_rays(tracks, poses, cameras, near_m) if tracks.points else near_m
    for i, mine in by_frame:
        off = poses[i].image_from_ground(cameras[i], points_m[tracks.point[mine]]) - tracks.image_px[mine]
        np.add.at(sum_sq, tracks.point[mine], np.sum(off**2, axis=1))
    return points_m, np.sqrt(sum_sq / (2.0 * tracks.lengths))


def lens_terms(camera: Camera) -> tuple[float, ...]:
    """k1, k2, p1, p2, k3 of a Brown lens as OpenCV has it, or k1 to k4 of its fisheye."""
    corners = camera.ray_from_image(camera.corners_px)[:, :2]
    widest = float(np.linalg.norm(corners, axis=1).max())
    return tuple(opencv_terms(camera.kind, camera.terms, widest).tolist())
