"""Control and check points: residuals by any method's poses, the scale of their marks, the place of a block
adjusted without them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from geomosaic.adjustment.kernels.collinearity import Projections, Rows, kinds_of, project, readout_of
from geomosaic.adjustment.kernels.interior import interior_of
from geomosaic.adjustment.model import Block, ControlResidual, GroundControl
from geomosaic.adjustment.procedure.blunder_detection import WITHIN_PX
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.terms.gnss_positions import ANYWHERE_M
from geomosaic.adjustment.terms.term import MEASURED_SD_PX
from geomosaic.arrays import Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.linear import inverse, is_parallel, singular_values, solve
from geomosaic.estimation.robust import STRONG, cauchy_cost
from geomosaic.estimation.similarity import Similarity3D
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.prior import position_assumed
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import ControlPoint, Survey, Warn

CovarianceOf = Callable[[Ints, Floats, Floats], Floats]
"""Covariance (3, 3) of what depends on poses and lenses: frames (k,), derivatives by their poses
(k, 3, 6) and by their cameras' numbers (k, 3, 9)."""
Free = Callable[[Block], tuple[Poses, tuple[Camera, ...]]]
"""Poses and the camera of each frame, of a block adjusted without control points."""
_BY_CHANCE = tuned(1e-6, "probability", "of marks all near the first corner, if spread over whole images")
_STEP = tuned(0.01, "share", "between the scales that are tried first; then a twentieth of it")
_DOUBT_RAD = tuned(0.1, "rad", "of a turn about a line of points: more turns blocks over")


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
    block: Block, poses: Poses, propagate: CovarianceOf | None = None
) -> tuple[ControlResidual, ...]:
    """Where each point was surveyed minus where the images put it, by the block's cameras and given poses. A
    point of one image is projected on the ground; points that cannot be placed are left out. Args: propagate:
    covariance after a bundle, which used the points that aren't for checking. Without it all are check
    points, and the poses' own deviations count as independent."""
    out = []
    for c in (c for c in block.control if c.observations):
        found = _place(poses, block, c)
        if found is None:
            continue
        frames = np.array([frame for frame, _, _ in c.observations], dtype=np.intp)
        at_m, own, by_pose, by_interior = found
        moved = (propagate or covariance_of_poses(poses))(frames, by_pose, by_interior)
        sd = np.sqrt(np.maximum(np.diag(own + moved), 0.0) + c.sd_m**2)
        out.append(
            ControlResidual(c.name, c.check or propagate is None, len(frames), c.enu_m - at_m, sd, c.sd_m)
        )
    return tuple(out)


def covariance_of(solution: Solution, camera_of: Ints) -> CovarianceOf:
    """Covariance of what depends on a solution's poses and cameras, with all correlations. Args: camera_of
    (f,): the camera's index of each frame."""
    layout = solution.estimate.layout

    def propagate(frames: Ints, by_pose: Floats, by_interior: Floats) -> Floats:
        poses, shared = np.zeros((len(camera_of), 6, 3)), np.zeros((layout.size, 3))
        np.add.at(poses, frames, np.swapaxes(by_pose, 1, 2))
        of_cameras = shared[layout.interior].reshape(len(layout.cameras), -1, 3)
        np.add.at(of_cameras, camera_of[frames], np.swapaxes(by_interior, 1, 2))
        return solution.stated.reduced.propagate(poses, shared)

    return propagate


def covariance_of_poses(poses: Poses) -> CovarianceOf:
    """That of poses as if they were independent."""
    sd = np.column_stack([poses.positions_sd_m, poses.rotations_sd_rad])
    variance = np.where(np.isfinite(sd), sd, ANYWHERE_M) ** 2

    def propagate(frames: Ints, by_pose: Floats, by_interior: Floats) -> Floats:
        return np.asarray(np.einsum("kia,ka,kja->ij", by_pose, variance[frames], by_pose))

    return propagate


def _place(
    poses: Poses, block: Block, control: GroundControl
) -> tuple[Floats, Floats, Floats, Floats] | None:
    """A ground point (3,) from its k image coordinates, by least squares, and its covariance (3, 3) for poses
    and cameras without error. Also its derivatives by the frames' poses (k, 3, 6) and cameras (k, 3, 9). None
    where it cannot be placed. In a single image the ground's height is as good as the surveyed point says."""
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


def in_several_images(control: Sequence[GroundControl]) -> list[GroundControl]:
    """Points with marks in two images or more."""
    return [c for c in control if len({frame for frame, _, _ in c.observations}) > 1]


def rays_meet_m(
    poses: Poses, cameras: Sequence[Camera], control: GroundControl, scale: float = 1.0
) -> Floats:
    """The nearest point (3,) in m to the rays of a control point's marks, enlarged by scale."""
    frames = np.array([i for i, _, _ in control.observations], dtype=np.intp)
    marks_px = np.array([(scale * col, scale * row) for _, col, row in control.observations])
    return intersection_of_rays(poses, tuple(cameras), frames, marks_px)


def with_marks_of_whole_images(block: Block, free: Free) -> tuple[Block, tuple[Warn, ...]]:
    """The block with enlarged image marks, where all lie near the first corner and rays of one point meet at
    one enlargement alone. Some programs write marks of reduced images, which no file states."""
    marks, several = (
        [mark for c in block.control for mark in c.observations],
        in_several_images(block.control),
    )
    sizes = [(block.cameras[i].width_px, block.cameras[i].height_px) for i, _, _ in marks]
    share = max((max(m[1] / w, m[2] / h) for m, (w, h) in zip(marks, sizes, strict=True)), default=0.0)
    if not several or share <= 0.0 or share ** (2 * len(marks)) > _BY_CHANCE:
        return block, ()
    if all(0.0 <= m[1] <= 1.0 and 0.0 <= m[2] <= 1.0 for m in marks):
        text = (
            f"all {len(marks)} image marks of the control points lie between 0 and 1: taken as shares of the "
            "images' width and height; give marks in pixels to be sure"
        )
        shares = _enlarged(block, [(float(c.width_px), float(c.height_px)) for c in block.cameras])
        return shares, (Warn("control-marks-enlarged", "", text),)
    poses, cameras = free(replace(block, control=()))

    def cost(scale: float) -> float:
        miss_px = np.concatenate([_miss_px(poses, cameras, c, scale) for c in several])
        return float(cauchy_cost(miss_px / scale / WITHIN_PX).sum()) / 2.0

    count = int(np.ceil(-np.log(share) / np.log1p(_STEP))) + 1
    best = min(np.geomspace(1.0, 1.0 / share, count).tolist(), key=cost)
    best = min((best * (1.0 + np.linspace(-_STEP, _STEP, 41))).tolist(), key=cost)
    if best < 1.0 + _STEP or cost(1.0) - cost(best) < np.log(STRONG):
        return block, ()
    text = (
        f"all {len(marks)} image marks of the control points lie in the first {100.0 * share:.0f} % of the "
        f"width and height of their images. Their rays meet if the marks are enlarged by {best:.3f}: "
        "taken as measured in images reduced by that; give marks of the full images to be sure"
    )
    enlarged = _enlarged(block, [(best, best)] * len(block.cameras))
    return enlarged, (Warn("control-marks-enlarged", "", text),)


def _enlarged(block: Block, by: Sequence[tuple[float, float]]) -> Block:
    """The block with each frame's marks enlarged, by two factors for col and row."""
    control = tuple(
        replace(c, observations=tuple((i, by[i][0] * col, by[i][1] * row) for i, col, row in c.observations))
        for c in block.control
    )
    return replace(block, control=control)


def _miss_px(poses: Poses, cameras: Sequence[Camera], control: GroundControl, scale: float) -> Floats:
    """Distances (k,) of the enlarged marks from the image of their point, at most an image's longer side."""
    at_m, miss_px = rays_meet_m(poses, cameras, control, scale), []
    for i, col, row in control.observations:
        off = poses[i].image_from_ground(cameras[i], at_m) - [scale * col, scale * row]
        miss_px.append(np.fmin(np.linalg.norm(off), max(cameras[i].width_px, cameras[i].height_px)))
    return np.array(miss_px, dtype=np.float64)


def placed_by_control(block: Block, free: Free) -> Poses | None:
    """The free block's poses after the similarity of space onto the control points. None where a frame has a
    position, where the block has several parts, or with fewer than three control points in two images each or
    on a line. Also None where frames
    would be tilted by more than stated while the points leave the turn about their line open. Then
    similarities of the plane georeference the block."""
    used = [c for c in in_several_images(block.control) if not c.check]
    parts = connected_parts(len(block.names), block.ties.frames)
    in_parts = sum(len(part) > 1 for part in parts) > 1
    if len(used) < 3 or in_parts or not position_assumed(block.poses).all():
        return None
    poses, cameras = free(replace(block, control=()))
    at = np.array([rays_meet_m(poses, cameras, c) for c in used])
    known = np.isfinite(at).all(axis=1)
    at, there = at[known], np.array([c.enu_m for c in used])[known]
    onto = Similarity3D.through(at, there)
    if onto is None or onto.scale <= 0.0:
        return None
    off_m = float(np.median(np.linalg.norm(onto.of(at) - there, axis=1)))
    across_m = singular_values(there - there.mean(axis=0))[1][1] / np.sqrt(len(there))
    rotations = onto.rotation @ poses.rotations
    tilts_rad = np.arccos(np.clip(rotations[:, 2, 2], -1.0, 1.0))
    usual_rad = float(np.median(block.poses.rotations_sd_rad[:, :2]))
    if np.median(tilts_rad) > usual_rad and off_m > _DOUBT_RAD * across_m:
        return None
    return replace(block.poses, positions_m=onto.of(poses.positions_m), rotations=rotations)
