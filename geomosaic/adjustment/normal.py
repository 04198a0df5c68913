"""Normal equations of a bundle, reduced to poses and cameras by the Schur complement on the points."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix
from scipy.sparse.linalg import splu

from geomosaic.errors import NotSolvableError

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_DENSE_UNKNOWNS = 2400
_UNDETERMINED = "the block does not determine the poses of its frames"


@dataclass(frozen=True)
class Normals:
    """Blocks of A'PA and A'Pl: f frames of 6 unknowns, c cameras of k, p points of 3, and what all frames
    share: the ground's level and q unknowns of the mounting, which meet the poses alone.

    The observations' own blocks (frame by point) are kept as they are, for the reduction.
    """

    frame: Ints
    point: Ints
    camera_of: Ints
    pose: Floats
    """(f, 6, 6)"""
    interior: Floats
    """(c, k, k)"""
    points: Floats
    """(p, 3, 3)"""
    pose_interior: Floats
    """(f, 6, k), each frame with its own camera"""
    pose_point: Floats
    """(m, 6, 3), an observation each"""
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
    """(f, 6, q)"""
    mounting: Floats
    """(q, q)"""
    mounting_side: Floats
    """(q,)"""


def build_normals(
    frame: Ints,
    point: Ints,
    camera_of: Ints,
    counts: tuple[int, int, int],
    residual: Floats,
    weight: Floats,
    by_pose: Floats,
    by_interior: Floats,
    by_point: Floats,
) -> Normals:
    """Sums the image observations; priors are added to the diagonal blocks afterwards, unknowns of the
    mounting (none here) with them.

    Args: residual (m, 2) observed minus computed, weight (m,), derivatives as `collinearity.project`
        gives them; counts: frames, cameras, points.
    """
    f, c, p = counts
    camera = camera_of[frame]
    wp = by_pose * weight[:, None, None]
    wk = by_interior * weight[:, None, None]
    wx = by_point * weight[:, None, None]

    def gather(index: Ints, size: int, values: Floats) -> Floats:
        into = csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))), shape=(size, len(index)))
        return np.asarray(into @ values.reshape(len(values), -1)).reshape((size, *values.shape[1:]))

    t = np.swapaxes
    both = camera * p + point
    return Normals(
        frame=frame,
        point=point,
        camera_of=camera_of,
        pose=gather(frame, f, t(by_pose, 1, 2) @ wp),
        interior=gather(camera, c, t(by_interior, 1, 2) @ wk),
        points=gather(point, p, t(by_point, 1, 2) @ wx),
        pose_interior=gather(frame, f, t(by_pose, 1, 2) @ wk),
        pose_point=t(by_pose, 1, 2) @ wx,
        interior_point=gather(both, c * p, t(by_interior, 1, 2) @ wx).reshape(c, p, -1, 3),
        pose_side=gather(frame, f, (t(wp, 1, 2) @ residual[:, :, None])[:, :, 0]),
        interior_side=gather(camera, c, (t(wk, 1, 2) @ residual[:, :, None])[:, :, 0]),
        point_side=gather(point, p, (t(wx, 1, 2) @ residual[:, :, None])[:, :, 0]),
        level_point=np.zeros((p, 3)),
        level=0.0,
        level_side=0.0,
        pose_mounting=np.zeros((f, 6, 0)),
        mounting=np.zeros((0, 0)),
        mounting_side=np.zeros(0),
    )


@dataclass(frozen=True)
class Reduced:
    """The reduced system: poses (sparse), bordered by what frames share (dense), in this order: the numbers
    of each camera (c of k), the ground's level (1), the mounting (q); s = c k + 1 + q in all."""

    poses: csc_matrix
    border: Floats
    """(6f, s)"""
    shared: Floats
    """(s, s)"""
    pose_side: Floats
    shared_side: Floats
    points_inverse: Floats
    normals: Normals

    @cached_property
    def _solver(self) -> _Solver:
        return _Solver(self.poses)

    def solve(self) -> tuple[Floats, Floats, Floats, float, Floats]:
        """Corrections of poses (f, 6), interiors (c, k), points (p, 3), the ground's level and the
        mounting (q,)."""
        y = self._solver(np.column_stack([self.border, self.pose_side]))
        corner = self.shared - self.border.T @ y[:, :-1]
        shared = _spd_solve(corner, self.shared_side - self.border.T @ y[:, -1])
        pose = y[:, -1] - y[:, :-1] @ shared
        n = self.normals
        dp = pose.reshape(-1, 6)
        dk, level, mounting = np.split(shared, [n.interior_side.size, n.interior_side.size + 1])
        moved = np.einsum("mij,mi->mj", n.pose_point, dp[n.frame])
        side = n.point_side - np.stack(
            [np.bincount(n.point, moved[:, k], minlength=len(n.points)) for k in range(3)], axis=1
        )
        side -= np.einsum("cpij,ci->pj", n.interior_point, dk.reshape(n.interior_side.shape))
        side -= level * n.level_point
        points = np.einsum("pij,pj->pi", self.points_inverse, side)
        return dp, dk.reshape(n.interior_side.shape), points, float(level[0]), mounting

    def covariance(self) -> tuple[Floats, Floats]:
        """Covariances for unit weight, with all correlations: each pose's own (f, 6, 6), and the full matrix
        of what frames share (s, s)."""
        f, size = self.poses.shape[0] // 6, self.poses.shape[0]
        y = self._solver(self.border)
        corner: Floats = np.asarray(np.linalg.inv(self.shared - self.border.T @ y), dtype=np.float64)
        blocks = np.empty((f, 6, 6))
        for start in range(0, size, 600):
            stop = min(start + 600, size)
            unit = np.zeros((size, stop - start))
            unit[np.arange(start, stop), np.arange(stop - start)] = 1.0
            columns = self._solver(unit) + y @ (corner @ (y.T @ unit))
            for k in range(start // 6, stop // 6):
                blocks[k] = columns[6 * k : 6 * k + 6, 6 * k - start : 6 * k - start + 6]
        return blocks, corner

    def propagate(self, by_pose: Floats, by_shared: Floats) -> Floats:
        """Covariance (r, r) for unit weight of r quantities that depend on poses and shared unknowns.

        Args: derivatives by_pose (6f, r), by_shared (s, r).
        """
        solved = self._solver(np.column_stack([self.border, by_pose]))
        y, alone = solved[:, : self.border.shape[1]], solved[:, self.border.shape[1] :]
        rest = by_shared - y.T @ by_pose
        corner = self.shared - self.border.T @ y
        return np.asarray(by_pose.T @ alone + rest.T @ np.linalg.solve(corner, rest))


def reduce_normals(n: Normals, damping: float = 0.0) -> Reduced:
    """Eliminates the points (Triggs et al. 2000, section 6.1); damping is Levenberg-Marquardt's, relative
    to the diagonal."""
    f, (c, k) = len(n.pose), n.interior_side.shape
    pose, interior, points = (_damped(a, damping) for a in (n.pose, n.interior, n.points))
    inverse: Floats = np.asarray(np.linalg.inv(points), dtype=np.float64)
    scaled = n.pose_point @ inverse[n.point]
    order = np.lexsort((n.point, n.frame))
    starts = np.concatenate([[0], np.cumsum(np.bincount(n.frame, minlength=f))])
    shape = (6 * f, 3 * len(points))
    w = bsr_matrix((n.pose_point[order], n.point[order], starts), shape=shape, blocksize=(6, 3))
    wv = bsr_matrix((scaled[order], n.point[order], starts), shape=shape, blocksize=(6, 3))
    own = bsr_matrix((pose, np.arange(f), np.arange(f + 1)), shape=(6 * f, 6 * f), blocksize=(6, 6))
    reduced = own - wv @ w.T.tobsr(blocksize=(3, 6))
    by_camera = n.interior_point.transpose(1, 0, 2, 3).reshape(len(points), c * k, 3)
    wk = np.swapaxes(np.concatenate([by_camera, n.level_point[:, None, :]], axis=1), 1, 2)
    wk_flat = wk.reshape(3 * len(points), c * k + 1)
    to_mounting = n.pose_mounting.reshape(6 * f, -1)
    border = np.column_stack([-(wv @ wk_flat), to_mounting])
    for i in range(c):
        rows = np.flatnonzero(n.camera_of == i)
        index = (6 * rows[:, None] + np.arange(6)).ravel()
        border[index, k * i : k * i + k] += n.pose_interior[rows].reshape(-1, k)
    corner = block_diag(*interior, n.level, _damped(n.mounting, damping))
    shared_side = np.concatenate([n.interior_side.ravel(), [n.level_side], n.mounting_side])
    seen = slice(0, c * k + 1)  # what meets the points
    corner[seen, seen] -= wk_flat.T @ np.einsum("pij,pjk->pik", inverse, wk).reshape(3 * len(points), -1)
    eliminated = np.einsum("pij,pj->pi", inverse, n.point_side)
    shared_side[seen] -= wk_flat.T @ eliminated.ravel()
    return Reduced(
        poses=reduced.tocsc(),
        border=border,
        shared=corner,
        pose_side=n.pose_side.ravel() - w @ eliminated.ravel(),
        shared_side=shared_side,
        points_inverse=inverse,
        normals=n,
    )


def _damped(blocks: Floats, damping: float) -> Floats:
    out = blocks.copy()
    i = np.arange(blocks.shape[-1])
    out[..., i, i] *= 1.0 + damping
    return out


class _Solver:
    """Symmetric positive definite solves, scaled to a unit diagonal: dense where small, else sparse."""

    def __init__(self, matrix: csc_matrix) -> None:
        diagonal = matrix.diagonal()
        if not np.all(diagonal > 0.0):
            raise NotSolvableError(_UNDETERMINED)
        self._scale = 1.0 / np.sqrt(diagonal)
        size = matrix.shape[0]
        if size <= _DENSE_UNKNOWNS:
            scaled = matrix.toarray() * self._scale[:, None] * self._scale
            try:
                self._dense = cho_factor(scaled, overwrite_a=True, check_finite=False)
            except np.linalg.LinAlgError as error:
                raise NotSolvableError(_UNDETERMINED) from error
            self._sparse = None
        else:
            scaled = matrix.multiply(self._scale[:, None]).multiply(self._scale).tocsc()
            self._sparse = splu(
                scaled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )

    def __call__(self, side: Floats) -> Floats:
        scaled = self._scale[:, None] * side
        solved = cho_solve(self._dense, scaled) if self._sparse is None else self._sparse.solve(scaled)
        return np.asarray(self._scale[:, None] * solved)


def _spd_solve(matrix: Floats, side: Floats) -> Floats:
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.asarray(scale * np.linalg.solve(matrix * scale[:, None] * scale, scale * side))
