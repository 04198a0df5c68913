"""Where frames lie on the ground and how large their pixels are there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geomosaic.camera.exterior import Pose, Poses
from geomosaic.camera.interior import Camera
from geomosaic.projection.ground import GroundSurface

Floats = NDArray[np.float64]


def ground_from_image(pose: Pose, camera: Camera, ground: GroundSurface, image_px: Floats) -> Floats:
    """Ground points (..., 3) in the work frame of cols and rows (..., 2); NaN where a ray misses."""
    return ground.intersect(pose.centre_at(camera, image_px), pose.ray_from_image(camera, image_px))


def ground_from_images(
    frame: NDArray[np.intp], image_px: Floats, poses: Poses, cameras: Sequence[Camera], ground: GroundSurface
) -> Floats:
    """Ground points (m, 3) of places in many frames: frame (m,), cols and rows (m, 2), a pose and a camera a
    frame. NaN where a ray misses."""
    out = np.empty((len(frame), 3))
    order = np.argsort(frame, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(frame[order])) + 1) if len(frame) else []:
        i = int(frame[mine[0]])
        out[mine] = ground_from_image(poses[i], cameras[i], ground, image_px[mine])
    return out


def footprint(pose: Pose, camera: Camera, ground: GroundSurface, per_side: int = 8) -> Floats:
    """The frame's outline on the ground, (4 * per_side, 3), in the order of `Camera.border_px`."""
    return ground_from_image(pose, camera, ground, camera.border_px(per_side))


def ground_sampling_distance_m(pose: Pose, camera: Camera, ground: GroundSurface) -> float:
    """Side in metres of the square with the area of the middle pixel's footprint."""
    middle = np.array([camera.width_px / 2.0, camera.height_px / 2.0])
    half = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * 16.0
    p = ground_from_image(pose, camera, ground, middle + half)[:, :2]
    d1, d2 = p[2] - p[0], p[3] - p[1]
    return float(np.sqrt(abs(d1[0] * d2[1] - d1[1] * d2[0]) / 2.0) / 16.0)
