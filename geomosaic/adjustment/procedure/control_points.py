"""Control and check points: their residuals by any method's poses."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from geomosaic.adjustment.kernels.collinearity import Projections, Rows, kinds_of, project, readout_of
from geomosaic.adjustment.kernels.interior import interior_of
from geomosaic.adjustment.model import Block, ControlResidual, GroundControl
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.terms.gnss_positions import ANYWHERE_M
from geomosaic.adjustment.terms.term import MEASURED_SD_PX
from geomosaic.arrays import Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.linear import inverse, is_parallel, solve
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import ControlPoint, Survey

Spread = Callable[[Ints, Floats, Floats], Floats]
"""Covariance (3, 3) of what depends on poses and lenses: frames (k,), derivatives by their poses
(k, 3, 6) and by their cameras' numbers (k, 3, 9)."""


def ground_control(survey: Survey, ground: GroundSurface) -> tuple[GroundControl, ...]:
    """The survey's control and check points in the work frame; those without an image are left out. The work
    frame's up is taken for the point's own vertical: 1.6e-4 rad off per km from the centre. A point known in
    plan only lies on the ground."""
    number = {frame.name: i for i, frame in enumerate(survey.frames)}

    def place(p: ControlPoint) -> Floats:
        at = survey.work_frame.enu_from_geodetic(p.lon_deg, p.lat_deg, p.height_ellipsoidal_m)
        return np.array([*at[:2], ground.up_at(*at[:2])]) if p.plan_only else at

    return tuple(
        GroundControl(
            p.name,
            place(p),
            np.array([p.sd_horizontal_m, p.sd_horizontal_m, p.sd_vertical_m]),
            p.check,
            tuple((number[frame], col, row) for frame, col, row in p.images),
        )
        for p in survey.control
        if p.images
    )


def control_residuals(
    block: Block, poses: Poses, spread: Spread | None = None
) -> tuple[ControlResidual, ...]:
    """Where each point was surveyed minus where the images put it, by the block's cameras and given poses.

    A point of two images and more is intersected from its image coordinates alone, whether it took part in
    the solve or not; a point of one image is projected on the ground. Points that cannot be placed are left
    out. Args: spread: covariance after a bundle, which used the points that aren't for checking. Without it
    all are check points, and the poses' own deviations count as independent.
    """
    out = []
    for c in block.control:
        found = _place(poses, block, c)
        if found is None:
            continue
        frames = np.array([frame for frame, _, _ in c.observations], dtype=np.intp)
        at_m, own, by_pose, by_interior = found
        moved = (spread or spread_of_poses(poses))(frames, by_pose, by_interior)
        sd = np.sqrt(np.maximum(np.diag(own + moved), 0.0) + c.sd_m**2)
        out.append(
            ControlResidual(c.name, c.check or spread is None, len(frames), c.enu_m - at_m, sd, c.sd_m)
        )
    return tuple(out)


def spread_of(solution: Solution, camera_of: Ints) -> Spread:
    """Covariance of what depends on a solution's poses and cameras, with all correlations. Args: camera_of
    (f,): the camera's index of each frame."""
    layout = solution.estimate.layout

    def spread(frames: Ints, by_pose: Floats, by_interior: Floats) -> Floats:
        poses, shared = np.zeros((len(camera_of), 6, 3)), np.zeros((layout.size, 3))
        np.add.at(poses, frames, np.swapaxes(by_pose, 1, 2))
        of_cameras = shared[layout.interior].reshape(len(layout.cameras), -1, 3)
        np.add.at(of_cameras, camera_of[frames], np.swapaxes(by_interior, 1, 2))
        return solution.stated.reduced.propagate(poses, shared)

    return spread


def spread_of_poses(poses: Poses) -> Spread:
    """That of poses as if they were independent."""
    sd = np.column_stack([poses.positions_sd_m, poses.rotations_sd_rad])
    variance = np.where(np.isfinite(sd), sd, ANYWHERE_M) ** 2

    def spread(frames: Ints, by_pose: Floats, by_interior: Floats) -> Floats:
        return np.asarray(np.einsum("kia,ka,kja->ij", by_pose, variance[frames], by_pose))

    return spread


def _place(
    poses: Poses, block: Block, control: GroundControl
) -> tuple[Floats, Floats, Floats, Floats] | None:
    """A ground point (3,) from its k image coordinates, by least squares; its covariance (3, 3) for poses and
    cameras without error; its derivatives by the frames' poses (k, 3, 6) and cameras (k, 3, 9). None where it
    cannot be placed. In a single image the ground's height is as good as the surveyed point says."""
    frames = np.array([frame for frame, _, _ in control.observations], dtype=np.intp)
    image_px = np.array([at[1:] for at in control.observations])
    cameras, single = block.cameras, len(np.unique(frames)) == 1
    if single:
        at_m = ground_from_image(poses[frames[0]], cameras[frames[0]], block.ground, image_px.mean(axis=0))
    else:
        at_m = intersection_of_rays(poses, cameras, frames, image_px)
    interior = np.stack([interior_of(cameras[i]) for i in frames])
    heights = np.array([cameras[i].height_px for i in frames])
    read = readout_of(poses, poses.rotations, Rows(frames, image_px[:, 1], heights, interior[:, -1]))
    kinds = kinds_of([cameras[i] for i in frames])
    level = np.zeros((3, 3))
    if single:
        level[2, 2] = (MEASURED_SD_PX / max(abs(control.enu_m[2] - at_m[2]), 1e-3)) ** 2
    for _ in range(1 if single else 6):
        if not np.isfinite(at_m).all():
            return None
        many = np.broadcast_to(at_m, (len(frames), 3))
        image, by_pose, by_interior, by_point = project(
            Projections(poses.positions_m[frames], read.rotations, interior, many, read, kinds)
        )
        if not np.isfinite(image).all():
            return None
        try:
            cofactors = inverse(np.einsum("kai,kaj->ij", by_point, by_point) + level)
        except NotSolvableError:
            return None
        lever = cofactors @ np.swapaxes(by_point, 1, 2)
        if not single:
            at_m = at_m + np.einsum("kia,ka->i", lever, image_px - image)
    return at_m, MEASURED_SD_PX**2 * cofactors, -lever @ by_pose, -lever @ by_interior


def intersection_of_rays(poses: Poses, cameras: tuple[Camera, ...], frames: Ints, image_px: Floats) -> Floats:
    """The point with the least squared distances to the rays; NaN for parallel rays."""
    normal, side = np.zeros((3, 3)), np.zeros(3)
    for i, px in zip(frames, image_px, strict=True):
        ray = poses[i].ray_from_image(cameras[i], px)
        ray = ray / np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        normal += across
        side += across @ poses[i].centre_at(cameras[i], px)
    if is_parallel(normal, 1e12):
        return np.full(3, np.nan)
    return solve(normal, side)
