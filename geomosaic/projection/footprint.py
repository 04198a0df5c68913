"""Where frames lie on the ground and how large their pixels are there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomosaic.arrays import Floats, Ints
from geomosaic.camera.exterior import Pose, Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import FEW as FEW
from geomosaic.projection.ground import GroundSurface


def ground_from_image(pose: Pose, camera: Camera, ground: GroundSurface, image_px: Floats) -> Floats:
    """Ground points (..., 3) in the work frame of cols and rows (..., 2); NaN where a ray misses."""
    return ground.intersect(pose.centre_at(camera, image_px), pose.ray_from_image(camera, image_px))


def ground_from_images(
    frame: Ints, image_px: Floats, poses: Poses, cameras: Sequence[Camera], ground: GroundSurface
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


def sightings(
    pose: Pose, camera: Camera, ground: GroundSurface, image_px: Floats
) -> tuple[Floats, Floats, Floats]:
    """How places of a frame (..., 2), cols and rows, are seen.

    Returns: ground points (..., 3) in the work frame, m, NaN where a ray misses; tangents (...) of the angles
    off the vertical, infinite at the horizon and above it, NaN beyond the lens; the longer sides (...) in m
    of the pixels' ellipses on level ground.
    """
    points = ground_from_image(pose, camera, ground, image_px)
    half = np.array([[0.0, 0.0], [-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])
    rays = pose.ray_from_image(camera, np.asarray(image_px)[..., None, :] + half)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(rays[..., 2:] >= 0.0, np.inf, rays[..., :2] / -rays[..., 2:])
        (a, b), (c, d) = (np.moveaxis(slope[..., k + 1, :] - slope[..., k, :], -1, 0) for k in (1, 3))
        total = a * a + b * b + c * c + d * d
        both = np.sqrt(np.maximum(total**2 - 4.0 * (a * d - b * c) ** 2, 0.0))
        above_m = pose.position_m[2] - points[..., 2]
        return (
            points,
            np.hypot(*np.moveaxis(slope[..., 0, :], -1, 0)),
            above_m * np.sqrt((total + both) / 2.0),
        )


def sees_below(pose: Pose, camera: Camera, ground: GroundSurface) -> bool:
    """Whether a frame shows the ground below its projection centre."""
    east, north, _ = pose.position_m
    col, row = pose.image_from_ground(camera, [east, north, float(ground.up_at(east, north))])
    return bool(0.0 < col < camera.width_px and 0.0 < row < camera.height_px)


def survey_pixel_m(
    poses: Poses, cameras: Sequence[Camera], used: Sequence[bool], ground: GroundSurface
) -> float:
    """The median ground sampling distance (m) of the frames in use that show the ground below them, or of all
    where these are few; NaN where none sees the ground.

    Frames that look aside see coarsely what others see from above, and don't make the map coarser.
    """
    of = [i for i, use in enumerate(used) if use]
    pixels = np.array([ground_sampling_distance_m(poses[i], cameras[i], ground) for i in of])
    below = np.array([sees_below(poses[i], cameras[i], ground) for i in of], dtype=bool)
    known = np.isfinite(pixels)
    from_above = known & below
    some = from_above if from_above.sum() > FEW * known.sum() else known
    return float(np.median(pixels[some])) if some.any() else float("nan")
