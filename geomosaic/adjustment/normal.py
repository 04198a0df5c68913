"""Normal equations of a bundle, reduced to poses and cameras by the Schur complement on the points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import bsr_matrix, csr_matrix

from geomosaic.adjustment.block_tridiagonal import BlockTridiagonal
from geomosaic.constants import CHOSEN, Because

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_BATCH: Annotated[
    int,
    Because(
        "image observations",
        "linearised at once, whole frames of them: their derivatives (2 to 4 MB) stay in the processor's "
        "cache; fewer mean more calls, more go through the memory",
        CHOSEN,
    ),
] = 8192

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

    The m observations' own blocks (point by frame) are kept, in order of points, for the reduction.
    """

    frame: Ints
    point: Ints
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
    """(m, 3, d), an observation each"""
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
    frame: Ints,
    point: Ints,
    camera_of: Ints,
    counts: tuple[int, int, int, int],
    linearised: Callable[[Ints], tuple[Floats, Floats, Floats, Floats, Floats]],
    d: int = 6,
) -> Normals:
    """Sums the image observations; priors are added to the diagonal blocks afterwards, unknowns of the
    mounting (none here) with them.

    Derivatives are asked for some frames at a time, so that no array of all of them is ever made.

    Args: frame, point (m,): in order of points; camera_of (f,); counts: frames, cameras, numbers of a
        camera, points; d: unknowns of a frame. linearised: of some observations (n,) residuals (n, 2)
        observed minus computed, weights (n,), and derivatives by pose, interior and point as
        `collinearity.project` gives them.
    """
    f, c, k, p = counts
    order, ends = _sorted(frame, f)
    point_pose = np.empty((len(order), 3, d))
    in_frame, in_point = np.empty((f, d + k + 1, d + k + 1)), np.zeros((c * p, 3, k + 4))
    for first, last in _batches(ends):
        which = order[ends[first] : ends[last]]
        residual, weight, by_pose, by_interior, by_point = linearised(which)
        rows = np.concatenate([by_pose, by_interior, residual[:, :, None], by_point], axis=2)
        rows *= np.sqrt(weight)[:, None, None]
        for i in range(first, last):
            mine = rows[ends[i] - ends[first] : ends[i + 1] - ends[first], :, :-3].reshape(-1, d + k + 1)
            in_frame[i] = mine.T @ mine
        by_rows = np.swapaxes(rows[:, :, -3:], 1, 2) @ rows
        point_pose[which] = by_rows[:, :, :d]
        met, local = np.unique(camera_of[frame[which]] * p + point[which], return_inverse=True)
        into, starts = _sorted(local, len(met))
        summing = csr_matrix((np.ones(len(into)), into, starts), shape=(len(met), len(into)))
        in_point[met] += (summing @ by_rows[:, :, d:].reshape(len(into), -1)).reshape(-1, 3, k + 4)
    of_camera = np.eye(c)[camera_of].T
    by_camera = in_point.reshape(c, p, 3, k + 4)
    both = by_camera[..., k:].sum(axis=0)
    return Normals(
        frame=frame,
        point=point,
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


def _sorted(number: Ints, size: int) -> tuple[Ints, Ints]:
    """Observations in order of their numbers below `size`; where those of each begin, and the end."""
    counts = np.bincount(number, minlength=size)
    return np.argsort(number, kind="stable"), np.concatenate([[0], np.cumsum(counts)])


def _batches(ends: Ints) -> Iterator[tuple[int, int]]:
    """Runs of frames with few enough observations for their derivatives to stay in the processor's cache."""
    first, frames = 0, len(ends) - 1
    while first < frames:
        last = int(np.searchsorted(ends, ends[first] + _BATCH, side="right")) - 1
        last = max(last, first + 1)
        yield first, last
        first = last


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
    def _factors(self) -> BlockTridiagonal:
        return BlockTridiagonal(self.poses)

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
        side = n.point_side - (_points_by_frames(n) @ pose).reshape(-1, 3)
        side -= np.einsum("cpij,ci->pj", n.interior_point, dk.reshape(n.interior_side.shape))
        side -= level * n.level_point
        points = np.einsum("pij,pj->pi", self.points_inverse, side)
        return dp, dk.reshape(n.interior_side.shape), points, float(level[0]), mounting

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
    to the diagonal."""
    (f, d), (c, k) = n.pose_side.shape, n.interior_side.shape
    pose, interior = (_damped(a, damping) for a in (n.pose, n.interior))
    points = _damped(n.points, max(damping, _LEAST_OF_POINTS))
    inverse: Floats = np.asarray(np.linalg.inv(points), dtype=np.float64)
    by_camera = n.interior_point.transpose(1, 3, 0, 2).reshape(len(points), 3, c * k)
    met = np.concatenate([by_camera, n.level_point[:, :, None], n.point_side[:, :, None]], axis=2)
    flat = met.reshape(3 * len(points), -1)
    less, less_beside = _met_through_points(n, inverse, flat)
    less_shared = flat.T @ (inverse @ met).reshape(flat.shape)
    own = bsr_matrix((pose, np.arange(f), np.arange(f + 1)), shape=(d * f, d * f), blocksize=(d, d))
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
        poses=own - less,
        border=border,
        shared=corner,
        pose_side=n.pose_side.ravel() - less_beside[:, -1],
        shared_side=shared_side,
        points_inverse=inverse,
        normals=n,
    )


def _points_by_frames(n: Normals) -> bsr_matrix:
    """The points' rows of the normal equations in the columns of the poses, (3p, d f)."""
    starts = np.searchsorted(n.point, np.arange(len(n.points) + 1))
    shape = (3 * len(n.points), n.pose_side.size)
    return bsr_matrix((n.point_pose, n.frame, starts), shape=shape, blocksize=(3, n.pose.shape[1]))


def _met_through_points(n: Normals, inverse: Floats, beside: Floats) -> tuple[bsr_matrix, Floats]:
    """W V^-1 W' and W V^-1 times beside (3p, r), with W the poses' rows in the columns of the points and V
    the points' own blocks."""
    by_frames, (f, d) = _points_by_frames(n), n.pose_side.shape
    order, ends = _sorted(n.frame, f)
    products, others = [], []
    for first, last in _batches(ends):
        which = order[ends[first] : ends[last]]
        blocks = np.swapaxes(n.point_pose[which], 1, 2) @ inverse[n.point[which]]
        starts, shape = ends[first : last + 1] - ends[first], (d * (last - first), len(beside))
        scaled = bsr_matrix((blocks, n.point[which], starts), shape=shape, blocksize=(d, 3))
        products.append(scaled @ by_frames)
        others.append(scaled @ beside)
    counts = np.concatenate([np.diff(a.indptr) for a in products])
    together = (
        np.concatenate([a.data for a in products]),
        np.concatenate([a.indices for a in products]),
        np.concatenate([[0], np.cumsum(counts)]),
    )
    return bsr_matrix(together, shape=(d * f, d * f), blocksize=(d, d)), np.concatenate(others)


def _damped(blocks: Floats, damping: float) -> Floats:
    out = blocks.copy()
    i = np.arange(blocks.shape[-1])
    out[..., i, i] *= 1.0 + damping
    return out


def _spd_solve(matrix: Floats, side: Floats) -> Floats:
    """Scaled to a unit diagonal; side (s, r)."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))[:, None]
    return np.asarray(scale * np.linalg.solve(matrix * scale * scale.T, scale * side))
