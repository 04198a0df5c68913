"""Normal equations of a bundle, reduced to poses and cameras by the Schur complement on the points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import bsr_matrix

from geomosaic.adjustment.dissected import Dissected
from geomosaic.adjustment.sightings import Sightings
from geomosaic.constants import Because

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_LEAST_OF_POINTS: Annotated[
    float,
    Because(
        "share of the diagonal",
        "that stands for a direction of a point that no image shows: a wild one that came to lie at a camera "
        "has next to none along its ray, and its matrix no inverse; with more it would count, with less the "
        "inverse has no digits",
        "chosen; double precision has 16 digits, a square takes half of them",
    ),
] = 1e-12


@dataclass(frozen=True)
class Normals:
    """Blocks of A'PA and A'Pl: f frames of d unknowns (poses first), c cameras of k, p points of 3, and
    what all frames share: the ground's level and q unknowns of the mounting, which meet the poses alone.

    The m observations' own blocks (point by frame) are kept, in order of frames, for the reduction.
    """

    sightings: Sightings
    camera_of: Ints
    pose: Floats
    """(f, d, d)"""
    interior: Floats
    """(c, k, k)"""
    points: Floats
    """(p, 3, 3)"""
    pose_interior: Floats
    """(f, d, k), each frame with its own camera"""
    point_pose: Floats
    """(m, 3, d), a sighting each"""
    interior_point: Floats
    """(c, p, k, 3)"""
    pose_side: Floats
    interior_side: Floats
    point_side: Floats
    level_point: Floats
    """(p, 3), the ground's level by point: minus weight times the surface's normal"""
    level: float
    level_side: float
    pose_mounting: Floats
    """(f, d, q)"""
    mounting: Floats
    """(q, q)"""
    mounting_side: Floats
    """(q,)"""


def build_normals(
    sightings: Sightings,
    camera_of: Ints,
    counts: tuple[int, int],
    linearised: Callable[[Ints], tuple[Floats, Floats, Floats, Floats, Floats]],
    d: int = 6,
) -> Normals:
    """Sums the image observations; priors are added to the diagonal blocks afterwards, unknowns of the
    mounting (none here) with them.

    Derivatives are asked for some frames at a time, so that no array of all of them is ever made.

    Args: camera_of (f,); counts: cameras, numbers of a camera; d: unknowns of a frame. linearised: of some
        observations (n,) residuals (n, 2) observed minus computed, weights (n,), and derivatives by pose,
        interior and point as `collinearity.project` gives them.
    """
    (c, k), f, p = counts, sightings.frames, sightings.points
    point_pose = np.empty((len(sightings.order), 3, d))
    in_frame, in_point = np.empty((f, d + k + 1, d + k + 1)), np.zeros((c * p, 3 * (k + 4)))
    for batch in sightings.batches(camera_of):
        residual, weight, *derivatives = linearised(sightings.order[batch.span])
        rows, root = np.empty((2, d + k + 4, len(weight))), np.sqrt(weight)
        first = 0
        for part in (*derivatives[:2], residual[:, :, None], derivatives[2]):
            last = first + part.shape[2]
            np.multiply(part.transpose(1, 2, 0), root, out=rows[:, first:last])
            first = last
        starts = sightings.starts[batch.first : batch.last + 1] - batch.span.start
        for i, (here, end) in enumerate(pairwise(starts), batch.first):
            across, down = rows[:, :-3, here:end]
            in_frame[i] = across @ across.T + down @ down.T
        by_rows = np.einsum("aim,ajm->ijm", rows[:, -3:], rows)
        point_pose[batch.span] = by_rows[:, :d].transpose(2, 0, 1)
        in_point[batch.met] += batch.summed(by_rows[:, d:].reshape(3 * (k + 4), -1))
    of_camera = np.eye(c)[camera_of].T
    by_camera = in_point.reshape(c, p, 3, k + 4)
    both = by_camera[..., k:].sum(axis=0)
    return Normals(
        sightings=sightings,
        camera_of=camera_of,
        pose=in_frame[:, :d, :d].copy(),
        interior=np.tensordot(of_camera, in_frame[:, d:-1, d:-1], axes=1),
        points=both[..., 1:].copy(),
        pose_interior=in_frame[:, :d, d:-1],
        point_pose=point_pose,
        interior_point=np.swapaxes(by_camera[..., :k], 2, 3),
        pose_side=in_frame[:, :d, -1].copy(),
        interior_side=of_camera @ in_frame[:, d:-1, -1],
        point_side=both[..., 0].copy(),
        level_point=np.zeros((p, 3)),
        level=0.0,
        level_side=0.0,
        pose_mounting=np.zeros((f, d, 0)),
        mounting=np.zeros((0, 0)),
        mounting_side=np.zeros(0),
    )


@dataclass(frozen=True)
class Reduced:
    """The reduced system: poses (sparse), bordered by what frames share (dense), in this order: the numbers
    of each camera (c of k), the ground's level (1), the mounting (q); s = c k + 1 + q in all."""

    poses: bsr_matrix
    border: Floats
    """(d f, s)"""
    shared: Floats
    """(s, s)"""
    pose_side: Floats
    shared_side: Floats
    points_inverse: Floats
    normals: Normals

    @cached_property
    def _factors(self) -> Dissected:
        return Dissected(self.poses, self.normals.sightings.shared_points.dissection)

    def solve(self) -> tuple[Floats, Floats, Floats, float, Floats]:
        """Corrections of poses (f, d), interiors (c, k), points (p, 3), the ground's level and the
        mounting (q,)."""
        y = self._factors.solve(np.column_stack([self.border, self.pose_side]))
        corner = self.shared - self.border.T @ y[:, :-1]
        shared = _spd_solve(corner, (self.shared_side - self.border.T @ y[:, -1])[:, None])[:, 0]
        pose = y[:, -1] - y[:, :-1] @ shared
        n = self.normals
        dp = pose.reshape(len(n.pose), -1)
        dk, level, mounting = np.split(shared, [n.interior_side.size, n.interior_side.size + 1])
        by_pose = (n.point_pose @ dp[n.sightings.frame][:, :, None])[:, :, 0]
        side = n.point_side - _summed(by_pose, n.sightings.point, len(n.points))
        side -= np.einsum("cpij,ci->pj", n.interior_point, dk.reshape(n.interior_side.shape))
        side -= level * n.level_point
        points = np.einsum("pij,pj->pi", self.points_inverse, side)
        return dp, dk.reshape(n.interior_side.shape), points, float(level[0]), mounting

    def length(self, pose: Floats, interior: Floats, points: Floats, level: float, mounting: Floats) -> float:
        """Of a step as `solve` gives it, in deviations of the solved: nothing of frames, or that they share,
        nor any sum of it, moves by more."""
        shared = np.concatenate([interior.ravel(), [level], mounting])
        square = float(self.pose_side @ pose.ravel() + self.shared_side @ shared)
        return float(np.sqrt(max(square, 0.0)))

    def covariance(self) -> tuple[Floats, Floats]:
        """Covariances for unit weight, with all correlations: each frame's own (f, d, d), and the full matrix
        of what frames share (s, s)."""
        shared = self.shared_covariance()
        by_shared = self._by_border.reshape(len(self.normals.pose), -1, len(shared))
        return self._factors.inverse_blocks() + by_shared @ shared @ np.swapaxes(by_shared, 1, 2), shared

    def shared_covariance(self) -> Floats:
        """The second part of `covariance` alone."""
        return _spd_solve(self.shared - self.border.T @ self._by_border, np.eye(len(self.shared)))

    @cached_property
    def _by_border(self) -> Floats:
        return self._factors.solve(self.border)

    def considering(self, variance: Floats) -> Reduced:
        """The system whose covariances hold what is not known of shared unknowns that were not solved for.

        Their estimate is no better than it was before, whatever the images say, and the others are as
        wrong as that makes them (Schmidt's consider filter): the information left for them once all others
        are eliminated is their prior's alone.

        Args: variance (s,) for unit weight; 0 for those that were solved for.
        """
        held, free = np.flatnonzero(variance > 0.0), np.flatnonzero(variance == 0.0)
        through_poses = self.border.T @ self._by_border
        corner = self.shared - through_poses
        meet = corner[np.ix_(free, held)]
        through_shared = meet.T @ _spd_solve(corner[np.ix_(free, free)], meet)
        shared = self.shared.copy()
        own = through_poses[np.ix_(held, held)] + through_shared
        shared[np.ix_(held, held)] = own + np.diag(1.0 / variance[held])
        return replace(self, shared=shared)

    def propagate(self, by_pose: Floats, by_shared: Floats) -> Floats:
        """Covariance (r, r) for unit weight of r quantities that depend on poses and shared unknowns.

        Args: derivatives by_pose (f, 6, r), by_shared (s, r).
        """
        f, d = self.normals.pose_side.shape
        by_pose = np.pad(by_pose, ((0, 0), (0, d - by_pose.shape[1]), (0, 0))).reshape(d * f, -1)
        solved = self._factors.solve(np.column_stack([self.border, by_pose]))
        y, alone = solved[:, : self.border.shape[1]], solved[:, self.border.shape[1] :]
        rest = by_shared - y.T @ by_pose
        corner = self.shared - self.border.T @ y
        return np.asarray(by_pose.T @ alone + rest.T @ np.linalg.solve(corner, rest))


def reduce_normals(n: Normals, damping: float = 0.0) -> Reduced:
    """Eliminates the points (Triggs et al. 2000, section 6.1); damping is Levenberg-Marquardt's, relative
    to the diagonal.

    With V = L L' of a point and W its rows in the columns of the poses, W' V^-1 W is the square of L^-1 W:
    what it takes away leaves no direction of the poses negative.
    """
    (f, d), (c, k) = n.pose_side.shape, n.interior_side.shape
    pose, interior = (_damped(a, damping) for a in (n.pose, n.interior))
    root = _inverse_root(_damped(n.points, max(damping, _LEAST_OF_POINTS)))
    by_camera = n.interior_point.transpose(1, 3, 0, 2).reshape(len(root), 3, c * k)
    met = np.concatenate([by_camera, n.level_point[:, :, None], n.point_side[:, :, None]], axis=2)
    beside = root @ met
    own, across, less_beside = _met_through_points(n, root, beside)
    flat = beside.reshape(3 * len(beside), -1)
    less_shared = flat.T @ flat
    columns, starts, order = n.sightings.shared_points.matrix
    blocks = np.concatenate([pose - own, -across, -np.swapaxes(across, 1, 2)])[order]
    border = np.column_stack([-less_beside[:, :-1], n.pose_mounting.reshape(d * f, -1)])
    for i in range(c):
        rows = np.flatnonzero(n.camera_of == i)
        index = (d * rows[:, None] + np.arange(d)).ravel()
        border[index, k * i : k * i + k] += n.pose_interior[rows].reshape(-1, k)
    corner = block_diag(*interior, n.level, _damped(n.mounting, damping))
    corner[: c * k + 1, : c * k + 1] -= less_shared[:-1, :-1]
    shared_side = np.concatenate([n.interior_side.ravel(), [n.level_side], n.mounting_side])
    shared_side[: c * k + 1] -= less_shared[:-1, -1]
    return Reduced(
        poses=bsr_matrix((blocks, columns, starts), shape=(d * f, d * f)),
        border=border,
        shared=corner,
        pose_side=n.pose_side.ravel() - less_beside[:, -1],
        shared_side=shared_side,
        points_inverse=np.swapaxes(root, 1, 2) @ root,
        normals=n,
    )


def _inverse_root(points: Floats) -> Floats:
    """L^-1 of points' blocks L L', (p, 3, 3)."""
    v = np.ascontiguousarray(np.moveaxis(points, 0, -1))
    out = np.zeros_like(v)
    a = 1.0 / np.sqrt(v[0, 0])
    p, q = v[1, 0] * a, v[2, 0] * a
    b = 1.0 / np.sqrt(v[1, 1] - p * p)
    r = (v[2, 1] - p * q) * b
    c = 1.0 / np.sqrt(v[2, 2] - q * q - r * r)
    out[0, 0], out[1, 1], out[2, 2] = a, b, c
    out[1, 0], out[2, 1] = -p * a * b, -r * b * c
    out[2, 0] = (p * r * b - q) * a * c
    return np.ascontiguousarray(np.moveaxis(out, -1, 0))


def _met_through_points(n: Normals, root: Floats, beside: Floats) -> tuple[Floats, Floats, Floats]:
    """W V^-1 W' and W V^-1 times what lies beside, with W the poses' rows in the columns of the points and V
    the points' own blocks: of each frame (f, d, d), of each pair that shares points (k, d, d), and (d f, r).

    Args: root (p, 3, 3): of the inverse; beside (p, 3, r), multiplied with it.
    """
    s, (f, d) = n.sightings, n.pose_side.shape
    shared = s.shared_points
    own, others = np.empty((f, d, d)), np.empty((f, d, beside.shape[2]))
    across = np.empty((len(shared.left), d, d))
    scaled = np.empty((len(s.point), 3 * d))
    for first, last in s.spans():
        for i in range(first, last):
            span = slice(s.starts[i], s.starts[i + 1])
            point = s.point[span]
            mine = (root[point] @ n.point_pose[span]).reshape(-1, d)
            scaled[span] = mine.reshape(len(point), 3 * d)
            own[i] = mine.T @ mine
            others[i] = mine.T @ beside[point].reshape(len(mine), beside.shape[2])
    for first, last in shared.spans():
        begin, end = shared.starts[first], shared.starts[last]
        one, other = (scaled.take(a[begin:end], axis=0).reshape(-1, d) for a in (shared.one, shared.other))
        starts = 3 * (shared.starts[first : last + 1] - begin)
        for i, (here, there) in enumerate(pairwise(starts), first):
            across[i] = one[here:there].T @ other[here:there]
    return own, across, others.reshape(d * f, -1)


def _summed(values: Floats, point: Ints, points: int) -> Floats:
    """Values (m, 3) added up by their point, (points, 3)."""
    return np.stack([np.bincount(point, values[:, a], points) for a in range(values.shape[1])], axis=1)


def _damped(blocks: Floats, damping: float) -> Floats:
    out = blocks.copy()
    i = np.arange(blocks.shape[-1])
    out[..., i, i] *= 1.0 + damping
    return out


def _spd_solve(matrix: Floats, side: Floats) -> Floats:
    """Scaled to a unit diagonal; side (s, r)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))[:, None]
    return np.asarray(scale * np.linalg.solve(matrix * scale * scale.T, scale * side))
