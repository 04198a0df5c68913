"""Control and check points: residuals by any method's poses, blunders, a common shift, and their warnings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from geomosaic.adjustment.kernels.collinearity import Projections, Rows, kinds_of, project, readout_of
from geomosaic.adjustment.kernels.interior import interior_of
from geomosaic.adjustment.model import Block, ControlResidual, GroundControl
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.terms.gnss_positions import ANYWHERE_M
from geomosaic.adjustment.terms.term import MEASURED_SD_PX
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.linear import inverse, is_parallel, solve
from geomosaic.estimation.robust import FAR, LEAST_OBSERVATIONS, THREE_SIGMA, blunders
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.accuracy import POSITION
from geomosaic.survey.model import ControlPoint, Survey, Warn
from geomosaic.survey.names import some

Spread = Callable[[Ints, Floats, Floats], Floats]
"""Covariance (3, 3) of what depends on poses and lenses: frames (k,), derivatives by their poses
(k, 3, 6) and by their cameras' numbers (k, 3, 9)."""
_AXES = ("east", "north", "up")
_DISAGREE: Final = {"control": "control-disagrees", "check": "check-disagrees"}
_SHIFT: Final = {"control": "control-shifted", "check": "check-shifted"}


@dataclass(frozen=True)
class Solved:
    """The covariance after a bundle, and the common error of all frames, (3,) in m², see `common_error`."""

    spread: Spread
    common_m2: Floats


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
    block: Block,
    poses: Poses,
    cameras: tuple[Camera, ...],
    ground: GroundSurface,
    solved: Solved | None = None,
) -> tuple[ControlResidual, ...]:
    """Where each point was surveyed minus where the images put it, by the poses as they are.

    A point of two images and more is intersected from its image coordinates alone, whether it took part in
    the solve or not; a point of one image is projected on the ground. Points that cannot be placed are left
    out. Args: solved: the covariance of poses and cameras after a bundle, which used the points that aren't
    for checking. Without it all are check points, and the poses' own deviations count as independent.
    """
    out = []
    for c in block.control:
        found = _place(poses, cameras, ground, c)
        if found is None:
            continue
        frames = np.array([frame for frame, _, _ in c.observations], dtype=np.intp)
        at_m, own, by_pose, by_interior = found
        try:
            moved = (solved.spread if solved else spread_of_poses(poses))(frames, by_pose, by_interior)
        except NotSolvableError:
            moved = spread_of_poses(poses)(frames, by_pose, by_interior)
        common_m2 = solved.common_m2 if solved else 0.0
        sd = np.sqrt(np.maximum(np.diag(own + moved), 0.0) + c.sd_m**2 + common_m2)
        away = c.enu_m - at_m
        out.append(ControlResidual(c.name, c.check or solved is None, len(frames), away, sd, c.sd_m))
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
    poses: Poses, cameras: tuple[Camera, ...], ground: GroundSurface, control: GroundControl
) -> tuple[Floats, Floats, Floats, Floats] | None:
    """A ground point (3,) from its k image coordinates, by least squares; its covariance (3, 3) for poses and
    cameras without error; its derivatives by the frames' poses (k, 3, 6) and cameras (k, 3, 9). None where it
    cannot be placed. In a single image the ground's height is as good as the surveyed point says."""
    frames = np.array([frame for frame, _, _ in control.observations], dtype=np.intp)
    image_px = np.array([at[1:] for at in control.observations])
    single = len(np.unique(frames)) == 1
    if single:
        at_m = ground_from_image(poses[frames[0]], cameras[frames[0]], ground, image_px.mean(axis=0))
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


def known_residuals_m(points: Sequence[ControlResidual]) -> Floats:
    """Residuals (n, 3) east, north and up, surveyed minus found; NaN for a height that was not surveyed."""
    residual_m = np.array([p.residual_m for p in points]).reshape(-1, 3)
    sd_m = np.array([p.sd_m for p in points]).reshape(-1, 3)
    residual_m[~(sd_m[:, 2] < POSITION["none"].sd_vertical_m), 2] = np.nan
    return residual_m


def means(values: Floats) -> Floats:
    """Means (c,) of the finite values of each column (n, c); NaN for a column without any."""
    finite = np.isfinite(values)
    count = finite.sum(axis=0)
    total = np.where(finite, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def control_blunders(points: Sequence[ControlResidual]) -> Bools:
    """Which of n points of one kind are blunders against the others, see `estimation.robust.blunders`. A
    vector that all have in common is the map's shift, not a blunder."""
    found = np.zeros(len(points), dtype=bool)
    residual_m = known_residuals_m(points)
    for axis in range(3):
        known = np.flatnonzero(np.isfinite(residual_m[:, axis]))
        sd_m = np.array([p.sd_m[axis] for p in points])[known]
        found[known] |= blunders(residual_m[known, axis], sd_m)
    return found


def control_warnings(residuals: Sequence[ControlResidual]) -> list[Warn]:
    """One line for each blunder; of the others one line for a common shift beyond three stated deviations,
    and one for all points that disagree by more than five of theirs."""
    out = []
    for kind, check in (("control", False), ("check", True)):
        points = [r for r in residuals if r.check == check]
        out += _warnings_of(kind, points) if points else []
    return out


def _warnings_of(kind: str, points: Sequence[ControlResidual]) -> list[Warn]:
    wrong, off_m = control_blunders(points), known_residuals_m(points)
    if len(points) < LEAST_OBSERVATIONS or wrong.all():
        return _far(kind, points, off_m)
    rest = [p for p, its in zip(points, wrong, strict=True) if not its]
    shift_m = means(off_m[~wrong])
    scatter_m = float(np.sqrt(np.nansum(means((off_m[~wrong] - shift_m) ** 2))))
    named = [(p.name, away_m) for p, away_m, its in zip(points, off_m - shift_m, wrong, strict=True) if its]
    blunder_lines = [
        f"{kind} point '{name}' lies {_length(away_m):.2f} m from where the images and the other {len(rest)} "
        f"{kind} points put it ({_vector(away_m)}), these scatter by {scatter_m:.2f} m; "
        "check its coordinates and its marks in the images"
        for name, away_m in named
    ]
    return [
        *(Warn(_DISAGREE[kind], "", text) for text in blunder_lines),
        *_shifted(kind, rest, shift_m, scatter_m),
        *_far(kind, rest, off_m[~wrong] - shift_m),
    ]


def _shifted(kind: str, points: Sequence[ControlResidual], shift_m: Floats, scatter_m: float) -> list[Warn]:
    """A line for a common shift (3,) beyond three stated deviations."""
    known = np.isfinite(known_residuals_m(points))
    sd_m = np.where(known, [p.sd_m for p in points], np.nan)
    stated_m = np.array([np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else np.nan for c in sd_m.T])
    ratio = float(np.nanmax(np.abs(shift_m) / stated_m))
    if not ratio > THREE_SIGMA:
        return []
    text = (
        f"{len(points)} {kind} points lie off the map by one shift ({_vector(shift_m)}), {ratio:.1f} of its "
        f"stated deviations, and scatter by {scatter_m:.2f} m about it; check the datum and height system of "
        f"the positions and of these points{', or use them as control' if kind == 'check' else ''}"
    )
    return [Warn(_SHIFT[kind], "", text)]


def _far(kind: str, points: Sequence[ControlResidual], off_m: Floats) -> list[Warn]:
    """One line for all points that lie more than five of their deviations off, (n, 3)."""
    share = np.nan_to_num(np.abs(off_m) / np.array([p.sd_m for p in points])).max(axis=1)
    far = [(p.name, at) for p, at, s in zip(points, off_m, share, strict=True) if s > FAR]
    if not far:
        return []
    few = len(points) < LEAST_OBSERVATIONS
    names = "" if few and len(points) > 1 else f" ({some(name for name, _ in far)})"
    worst_m = max((at for _, at in far), key=_length)
    text = (
        f"{len(far)} of {len(points)} {kind} points{names} disagree with the images by more than "
        f"{FAR:g} deviations, the farthest by {_length(worst_m):.2f} m ({_vector(worst_m)})"
        f"{f', and fewer than {LEAST_OBSERVATIONS} points do not show which is wrong' if few else ''}; "
        "check their coordinates and their marks in the images"
    )
    return [Warn(_DISAGREE[kind], "", text)]


def _length(off_m: Floats) -> float:
    return float(np.sqrt(np.nansum(off_m**2)))


def _vector(off_m: Floats) -> str:
    """What is known of east, north and up."""
    return ", ".join(f"{v:+.2f} {axis}" for v, axis in zip(off_m, _AXES, strict=True) if np.isfinite(v))
