"""The Cramér-Rao bound of a drawn block, computed apart from the package's solver.

The inverse of the Fisher information at the truth, from central differences of `Pose.image_from_ground`, the
true deviations and the priors (Van Trees 1968, section 2.4). Headings may be off in common by a frame's
deviation. Tie points are eliminated; poses, and what all frames share (the lens where it is drawn, the
ground's level), stay. For `bench_monte_carlo.py` and the tests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_matrix, diags
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation as Turn

from geomosaic.adjustment.model import Block
from geomosaic.camera.exterior import Pose, Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.projection.ground import GroundSurface

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
LENS = ("focal_length_px", "principal_col_px", "principal_row_px", "k1", "k2", "k3", "p1", "p2")
LENS_STEP = (1e-2, 1e-2, 1e-2, 1e-5, 1e-5, 1e-5, 1e-6, 1e-6)
POSE_STEP = (1e-3, 1e-3, 1e-3, 1e-6, 1e-6, 1e-6)
POINT_STEP_M = 1e-3
LEVEL_SD_M = 1e3
_SAMPLED_POINTS = 400


@dataclass(frozen=True)
class Draw:
    """A block as reported, and the truth: poses, lens, tie points (on the block's ground); which frame saw
    which where, (m,) and (m, 2), with noise_px on each axis.

    lens_sd: (8,) prior deviations of the reported lens in the order of LENS; None where it is known.
    """

    block: Block
    poses: Poses
    camera: Camera
    points_m: Floats
    frame: Ints
    point: Ints
    image_px: Floats
    noise_px: float
    lens_sd: Floats | None

    @property
    def reported_pose_errors(self) -> Floats:
        """(f, 6): POS minus truth."""
        return pose_errors(self.block.poses, self.poses)


def size_px(camera: Camera) -> Floats:
    return np.array([camera.width_px, camera.height_px], dtype=np.float64)


def lens_of(camera: Camera) -> Floats:
    return np.array([getattr(camera, name) for name in LENS])


def with_lens(camera: Camera, lens: Floats) -> Camera:
    values: dict[str, Any] = {name: float(v) for name, v in zip(LENS, lens, strict=True)}
    return replace(camera, **values)


def turned(rotations: Floats, turn_rad: Floats) -> Floats:
    """exp([t]) R of turns t about the work frame's axes."""
    return np.asarray(Turn.from_rotvec(turn_rad).as_matrix() @ rotations)


def axes_of(heading_rad: float) -> Floats:
    """Unit vectors along a heading and to its right, rows of east and north, (2, 2)."""
    sin, cos = np.sin(heading_rad), np.cos(heading_rad)
    return np.array([[sin, cos], [cos, -sin]])


def pose_errors(poses: Poses, truth: Poses) -> Floats:
    """(f, 6): east, north, up (m), then the turn t of R = exp([t]) R_true (rad)."""
    turn = Turn.from_matrix(poses.rotations @ np.swapaxes(truth.rotations, 1, 2)).as_rotvec()
    return np.column_stack([poses.positions_m - truth.positions_m, turn])


def derivatives(pose: Pose, camera: Camera, points_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Of image coordinates by central differences: (k, 2, 6) by position and turn, (k, 2, 8) by LENS,
    (k, 2, 3) by the points."""

    def central(steps: Sequence[float], at: Callable[[Floats], Floats]) -> Floats:
        unit = np.eye(len(steps)) * steps
        columns = [(at(u) - at(-u)) / (2.0 * step) for u, step in zip(unit, steps, strict=True)]
        return np.stack(columns, axis=-1)

    def posed(change: Floats) -> Floats:
        rotation = Rotation(turned(pose.rotation.matrix, change[3:]))
        return Pose(pose.position_m + change[:3], rotation).image_from_ground(camera, points_m)

    lens = lens_of(camera)
    return (
        central(POSE_STEP, posed),
        central(LENS_STEP, lambda change: pose.image_from_ground(with_lens(camera, lens + change), points_m)),
        central([POINT_STEP_M] * 3, lambda change: pose.image_from_ground(camera, points_m + change)),
    )


def _on_ground(by_point: Floats, ground: GroundSurface, points_m: Floats) -> tuple[Floats, Floats]:
    """Derivatives by east and north along the ground's slope (k, 2, 2), and by its level (k, 2, 1)."""
    east, north, half = points_m[:, 0], points_m[:, 1], 1.0
    slope = np.column_stack([
        ground.up_at(east + half, north) - ground.up_at(east - half, north),
        ground.up_at(east, north + half) - ground.up_at(east, north - half),
    ]) / (2.0 * half)  # fmt: skip
    return by_point[:, :, :2] + by_point[:, :, 2:] * slope[:, None, :], by_point[:, :, 2:]


@dataclass(frozen=True)
class Bound:
    """The inverse of the Fisher information about poses (6 a frame), lens (8 if drawn), level (1).

    covariance: of these unknowns, tie points eliminated. oracle: the linear estimate's errors of them.
    points_m, points_by_unknown: some of the tie points, and how their east and north follow the unknowns,
    (k, 2, unknowns); points_own: their variance if the unknowns were known, (k, 2, 2).
    """

    covariance: Floats
    oracle: Floats
    points_m: Floats
    points_by_unknown: Floats
    points_own: Floats

    def pose_covariance(self, frames: int) -> Floats:
        """(f, 6, 6)."""
        part = self.covariance[: 6 * frames, : 6 * frames].reshape(frames, 6, frames, 6)
        return np.stack([part[i, :, i] for i in range(frames)])


def cramer_rao(d: Draw, *, on_ground: bool = True) -> Bound:
    """The bound for one draw. on_ground: tie points have two unknowns, and the ground one level; else
    three, and the level no meaning."""
    n, p = len(d.poses), len(d.points_m)
    lens = 6 * n + np.arange(8 * (d.lens_sd is not None))
    columns, each = 6 * n + len(lens) + 1, 2 if on_ground else 3
    by_unknown = _Triplets((2 * len(d.frame), columns))
    by_point = _Triplets((2 * len(d.frame), each * p))
    residual = np.empty((len(d.frame), 2))
    for i in range(n):
        mine = np.flatnonzero(d.frame == i)
        points = d.points_m[d.point[mine]]
        residual[mine] = d.image_px[mine] - d.poses[i].image_from_ground(d.camera, points)
        by_pose, by_lens, by_place = derivatives(d.poses[i], d.camera, points)
        by_unknown.add(mine, 6 * i + np.arange(6), by_pose)
        if d.lens_sd is not None:
            by_unknown.add(mine, lens, by_lens)
        if on_ground:
            by_place, by_level = _on_ground(by_place, d.block.ground, points)
            by_unknown.add(mine, np.array([columns - 1]), by_level)
        by_point.add(mine, each * d.point[mine][:, None] + np.arange(each), by_place)
    x, y = by_unknown.matrix() / d.noise_px, by_point.matrix() / d.noise_px
    white = residual.ravel() / d.noise_px
    own = np.linalg.inv((y.T @ y).tobsr((each, each)).data)
    lever = (block_diag(own, format="csr") @ (y.T @ x)).tocsr()
    pos = d.block.poses
    prior_sd = np.column_stack([pos.positions_sd_m, pos.rotations_sd_rad]).ravel()
    reported = d.reported_pose_errors.ravel()
    if d.lens_sd is not None:
        prior_sd = np.append(prior_sd, d.lens_sd)
        reported = np.append(reported, lens_of(d.block.cameras[0]) - lens_of(d.camera))
    prior, reported = np.append(prior_sd, LEVEL_SD_M) ** -2.0, np.append(reported, 0.0)
    information = (x.T @ x + diags(prior) - (y.T @ x).T @ lever).toarray()
    yaw, in_common = 6 * np.arange(n) + 5, np.zeros(columns)
    in_common[yaw] = prior[yaw]
    known = 1.0 / float(np.median(pos.rotations_sd_rad[:, 2])) ** 2 + float(prior[yaw].sum())
    information -= np.outer(in_common, in_common) / known
    scale = 1.0 / np.sqrt(np.diag(information))
    covariance = scale[:, None] * np.linalg.inv(scale[:, None] * information * scale) * scale
    side = x.T @ white - lever.T @ (y.T @ white) + prior * reported
    side -= in_common * float(in_common @ reported) / known
    some = np.unique(np.linspace(0, p - 1, _SAMPLED_POINTS).astype(np.intp))
    rows = (each * some[:, None] + np.arange(2)).ravel()
    follow = -lever[rows].toarray().reshape(len(some), 2, columns)
    return Bound(covariance, covariance @ side, d.points_m[some], follow, own[some][:, :2, :2])


class _Triplets:
    """A sparse matrix of observation rows, two an observation, put together part by part."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._shape = shape
        self._parts: list[tuple[Floats, Floats, Floats]] = []

    def add(self, observation: Ints, column: Ints, value: Floats) -> None:
        """Args: observation (k,); column (c,) or (k, c); value (k, 2, c)."""
        row = np.broadcast_to((2 * observation[:, None] + np.arange(2))[:, :, None], value.shape)
        column = np.broadcast_to(column[..., None, :], value.shape)
        self._parts.append((row.ravel(), column.ravel(), value.ravel()))

    def matrix(self) -> csr_matrix:
        row, column, value = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        return csr_matrix((value, (row, column)), shape=self._shape)


@dataclass(frozen=True)
class Grid:
    """Ground points (k, 3), which frame shows each in the mosaic and where; by_unknown (k, 2, unknowns):
    how the place shown moves with poses, lens and level."""

    points_m: Floats
    frame: Ints
    image_px: Floats
    by_unknown: Floats


def grid(d: Draw, heading_rad: float, spacing_m: float) -> Grid:
    """Points of a square grid, along the first flight line, that the frame of the nearest nadir sees."""
    nadir = d.poses.positions_m[:, :2]
    axes = axes_of(heading_rad)
    low, high = (nadir @ axes).min(axis=0) - 80.0, (nadir @ axes).max(axis=0) + 80.0
    along, across = (np.arange(a, b, spacing_m) for a, b in zip(low, high, strict=True))
    at = np.stack(np.meshgrid(along, across), axis=-1).reshape(-1, 2) @ axes
    _, nearest = cKDTree(nadir).query(at)
    order = np.argsort(nearest, kind="stable")
    at, nearest = at[order], nearest[order]
    points = np.column_stack([at, d.block.ground.up_at(*at.T)])
    px, kept, parts = [], [], []
    for i in range(len(nadir)):
        mine = np.flatnonzero(nearest == i)
        image = d.poses[i].image_from_ground(d.camera, points[mine])
        inside = np.all((image > 0.0) & (image < size_px(d.camera)), axis=1)
        mine, image = mine[inside], image[inside]
        by_pose, by_lens, by_place = derivatives(d.poses[i], d.camera, points[mine])
        by_plan, by_level = _on_ground(by_place, d.block.ground, points[mine])
        row = np.zeros((len(mine), 2, 6 * len(nadir) + 8 * (d.lens_sd is not None) + 1))
        row[:, :, 6 * i : 6 * i + 6] = by_pose
        if d.lens_sd is not None:
            row[:, :, -9:-1] = by_lens
        row[:, :, -1:] = by_level
        parts.append(-np.linalg.solve(by_plan, row))
        px.append(image)
        kept.append(mine)
    of = np.concatenate(kept)
    return Grid(points[of], nearest[of], np.concatenate(px), np.concatenate(parts))


def bound_m(
    by_unknown: Floats, covariance: Floats, basis: Floats, own: Floats | None = None
) -> tuple[float, float]:
    """What `rmse_m` is in expectation for errors by_unknown (k, 2, u) with a covariance (u, u)."""
    a = by_unknown.reshape(-1, by_unknown.shape[-1])
    total, shared = (
        float(((a @ covariance) * a).sum()),
        float(((basis.T @ a @ covariance) * (basis.T @ a)).sum()),
    )
    if own is not None:
        total += float(np.trace(own, axis1=1, axis2=2).sum())
    return float(np.sqrt(total * 2.0 / len(a))), float(np.sqrt((total - shared) * 2.0 / len(a)))
