"""Normal equations reduced to poses and what frames share (Schur complement), solved and inverted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag
from scipy.sparse import bsr_matrix

from geomosaic.adjustment.kernels.ahead import ahead
from geomosaic.adjustment.kernels.normal_equations import SQUARE, Normals
from geomosaic.adjustment.kernels.observation_groups import Group
from geomosaic.adjustment.kernels.pose_jacobian import Levers
from geomosaic.arrays import Floats, Ints
from geomosaic.constants import tuned
from geomosaic.estimation.linear import inverse_roots, multiply_each, solve_scaled
from geomosaic.estimation.nested_dissection import Dissected

_LEAST_OF_POINTS = tuned(1e-12, "share of the diagonal", "with less, a point at a camera has no inverse")


@dataclass(frozen=True)
class Reduced:
    """The reduced system: poses (sparse), bordered by what frames share, border (d f, s) and shared (s, s).
    The shared unknowns are, in this order, the numbers of each camera (c of k), the ground's level (1) and
    the mounting (q). Their number is s = c k + 1 + q."""

    poses: bsr_matrix
    border: Floats
    shared: Floats
    pose_side: Floats
    shared_side: Floats
    points_inverse: Floats
    normals: Normals

    @property
    def level(self) -> int:
        """Where the ground's level is among what frames share."""
        return self.normals.interior_side.size

    @cached_property
    def _factors(self) -> Dissected:
        return Dissected(self.poses, self.normals.sightings.dissection)

    def solve(self) -> tuple[Floats, Floats, Floats, float, Floats]:
        """Corrections of poses (f, d), interiors (c, k), points (p, 3), ground level, mounting (q,)."""
        alone = self._factors.solve(self.pose_side)
        corner = self.shared - self.border.T @ self._by_border
        shared = solve_scaled(corner, (self.shared_side - self.border.T @ alone)[:, None])[:, 0]
        pose = alone - self._by_border @ shared
        n = self.normals
        dp = pose.reshape(len(n.pose), -1)
        dk, level, mounting = np.split(shared, [self.level, self.level + 1])
        points = self.points_moved(dp, shared, n.point_side)
        return dp, dk.reshape(n.interior_side.shape), points, float(level[0]), mounting

    def points_moved(self, pose: Floats, shared: Floats, side: Floats) -> Floats:
        """Corrections of points (p, 3) by their right-hand side, those of poses (f, d) and shared (s,)."""
        out = np.empty_like(side)
        for group in self.normals.sightings.groups:
            out[group.points] = self.group_moved(group, pose, shared, side[group.points])
        return out

    def group_moved(self, group: Group, pose: Floats, shared: Floats, side: Floats) -> Floats:
        """The same of a group's points alone, with their right-hand side."""
        n, points, span = self.normals, group.points, group.span
        interior = shared[: self.level].reshape(n.interior_side.shape)
        side = side - np.einsum("cpij,ci->pj", n.interior_point[:, points], interior)
        step = pose.T.take(n.sightings.frame[span], axis=-1)
        by_pose = multiply_each(n.point_point[SQUARE, span], n.levers.of(span).as_points_m(step))
        side -= _summed_by(by_pose, n.sightings.point[span] - points.start, group.size)
        side -= shared[self.level] * n.level_point[points]
        return np.asarray(np.einsum("pij,pj->pi", self.points_inverse[points], side))

    def with_sides(self, pose_side: Floats, shared_side: Floats) -> Reduced:
        """The same equations with other right-hand sides."""
        return self._factors_for(replace(self, pose_side=pose_side, shared_side=shared_side))

    def _factors_for(self, other: Reduced) -> Reduced:
        """Equations with the same poses, which need no other factors of these."""
        kept = [name for name in ("_factors", "_by_border") if name in self.__dict__]
        other.__dict__.update({name: self.__dict__[name] for name in kept})
        return other

    def covariance(self) -> tuple[Floats, Floats]:
        """Covariances for unit weight: each frame's own (f, d, d), and of all that is shared (s, s)."""
        shared = self.shared_covariance()
        across = self.across_covariance(shared)
        return self._factors.inverse_blocks() - across @ np.swapaxes(self._each_by_border, 1, 2), shared

    def across_covariance(self, shared: Floats) -> Floats:
        """Covariance (f, d, s) of each frame with all that is shared, from that of the latter (s, s)."""
        return np.asarray(-self._each_by_border @ shared)

    @property
    def _each_by_border(self) -> Floats:
        return self._by_border.reshape(len(self.normals.pose), -1, len(self.shared))

    def shared_covariance(self) -> Floats:
        """The second part of `covariance` alone."""
        return solve_scaled(self.shared - self.border.T @ self._by_border, np.eye(len(self.shared)))

    @cached_property
    def _by_border(self) -> Floats:
        return self._factors.solve(self.border)

    def considering(self, variance: Floats) -> Reduced:
        """The system whose covariances include fixed shared unknowns with their prior variances (s,) for unit
        weight, 0 for solved ones: Schmidt's consider filter. The information left for the fixed ones, once
        all others are eliminated, is their prior's alone."""
        fixed, free = np.flatnonzero(variance > 0.0), np.flatnonzero(variance == 0.0)
        through_poses = self.border.T @ self._by_border
        corner = self.shared - through_poses
        meet = corner[np.ix_(free, fixed)]
        through_shared = meet.T @ solve_scaled(corner[np.ix_(free, free)], meet)
        shared = self.shared.copy()
        own = through_poses[np.ix_(fixed, fixed)] + through_shared
        shared[np.ix_(fixed, fixed)] = own + np.diag(1.0 / variance[fixed])
        return self._factors_for(replace(self, shared=shared))

    def moved(self, by_pose: Floats, by_shared: Floats) -> tuple[Floats, Floats]:
        """The inverse times derivatives of r quantities: the rows of the poses (f, d, r) and of the shared
        unknowns (s, r). Args: by_pose (f, 6, r), by_shared (s, r): derivatives of the quantities by poses and
        shared unknowns."""
        (f, d), r = self.normals.pose_side.shape, by_shared.shape[1]
        by_pose = np.pad(by_pose, ((0, 0), (0, d - by_pose.shape[1]), (0, 0))).reshape(d * f, r)
        alone = self._factors.solve(by_pose)
        corner = self.shared - self.border.T @ self._by_border
        shared = solve_scaled(corner, by_shared - self._by_border.T @ by_pose)
        return (alone - self._by_border @ shared).reshape(f, d, r), shared

    def propagate(self, by_pose: Floats, by_shared: Floats) -> Floats:
        """Covariance (r, r) for unit weight of such quantities."""
        pose, shared = self.moved(by_pose, by_shared)
        by_pose = by_pose.reshape(-1, by_shared.shape[1])
        pose = pose[:, : len(by_pose) // len(pose)].reshape(by_pose.shape)
        return np.asarray(by_pose.T @ pose + by_shared.T @ shared)


def reduce_normals(n: Normals, damping: float = 0.0) -> Reduced:
    """Eliminates the points (Triggs et al. 2000, section 6.1); damping is Levenberg-Marquardt's, relative to
    the diagonal. With V = L L' of a point and W its rows in the poses' columns, W' V^-1 W is the square of
    L^-1 W. Computed as a square, it leaves no direction of the poses negative."""
    (f, d), (c, k) = n.pose_side.shape, n.interior_side.shape
    s, interior, less_border = n.sightings, _damped(n.interior, damping), np.zeros((f, d, c * k + 2))
    less_shared, points_inverse = np.zeros((c * k + 2, c * k + 2)), np.empty((s.points, 3, 3))
    columns, starts, order = s.matrix
    blocks, place = np.zeros((len(order), d, d)), np.argsort(order)
    own, across, turned_over = np.split(place, [f, f + len(s.left)])
    blocks[own] = _damped(n.pose, damping)

    def less_of_frames(group: Group) -> Floats:
        nonlocal less_shared
        root = inverse_roots(_damped(n.points[group.points], max(damping, _LEAST_OF_POINTS)))
        points_inverse[group.points] = np.swapaxes(root, 1, 2) @ root
        by_camera = n.interior_point[:, group.points].transpose(1, 3, 0, 2).reshape(group.size, 3, -1)
        others = n.level_point[group.points, :, None], n.point_side[group.points, :, None]
        border_rows = root @ np.concatenate([by_camera, *others], axis=2)
        flat = border_rows.reshape(3 * len(border_rows), -1)
        less_shared += flat.T @ flat
        which = s.point[group.span] - group.points.start
        seen = n.levers.of(group.span), n.point_point[SQUARE, group.span]
        scaled = _scaled_rows(*seen, root, which)
        _less_of_frames(group, scaled, border_rows.take(which, axis=0), (blocks, own, less_border))
        return scaled

    for group, scaled in ahead(less_of_frames, s.groups):
        _less_of_pairs(group, scaled, blocks, across)
    blocks[turned_over] = np.swapaxes(blocks[across], 1, 2)
    less_border = less_border.reshape(d * f, -1)
    border = np.column_stack([-less_border[:, :-1], n.pose_mounting.reshape(d * f, -1)])
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
        pose_side=n.pose_side.ravel() - less_border[:, -1],
        shared_side=shared_side,
        points_inverse=points_inverse,
        normals=n,
    )


def _damped(blocks: Floats, damping: float) -> Floats:
    return blocks * (1.0 + damping * np.eye(blocks.shape[-1]))


def _scaled_rows(levers: Levers, point_point: Floats, root: Floats, which: Ints) -> Floats:
    """Blocks of point by pose times the roots of their points' inverses, and a block of zeros, (m + 1, 3, d).
    Args: point_point (3, 3, m): what each adds to its point's block; root (p, 3, 3); which (m,): of p
    points."""
    roots = np.ascontiguousarray(np.moveaxis(root, 0, -1)).take(which, axis=-1)
    by_pose = levers.by_pose(multiply_each(roots, point_point))
    out = np.zeros((len(which) + 1, *by_pose.shape[:2]))
    out[:-1] = by_pose.transpose(2, 0, 1)
    return out


def _less_of_frames(group: Group, scaled: Floats, seen: Floats, sums: tuple[Floats, Ints, Floats]) -> None:
    """Subtracts the Schur complement's part on the diagonal from each frame's block, and adds the products
    with the points' other columns. Args: scaled: of `_scaled_rows`; seen (m, 3, r): the other columns, scaled
    alike; sums: blocks (n, d, d), the frames' places in them (f,), the products (f, d, r)."""
    blocks, own, others = sums
    rows = scaled.reshape(-1, scaled.shape[-1])
    seen = seen.reshape(-1, seen.shape[-1])
    runs = pairwise((3 * group.runs).tolist())
    for i, at, (here, end) in zip(group.frames.tolist(), own[group.frames].tolist(), runs, strict=True):
        mine = rows[here:end]
        blocks[at] -= mine.T @ mine
        others[i] += mine.T @ seen[here:end]


def _less_of_pairs(group: Group, scaled: Floats, blocks: Floats, across: Ints) -> None:
    """Subtracts the Schur complement's part between frames; across (k,): the pairs' places among blocks."""
    m, _, d = scaled.shape
    rows, starts = scaled.reshape(m, -1), group.shared.tolist()
    left, right = np.empty((2, max(np.diff(starts), default=0), 3 * d))
    for (here, end), (begin, stop) in zip(pairwise(group.batches.tolist()), pairwise(starts), strict=True):
        for which, taken in ((group.one, left), (group.other, right)):  # "clip" writes without a buffer
            rows.take(which[begin:stop], axis=0, out=taken[: stop - begin], mode="clip")
        one, other = (taken[: stop - begin].reshape(end - here, -1, d) for taken in (left, right))
        blocks[across[group.pairs[here:end]]] -= np.swapaxes(one, 1, 2) @ other


def _summed_by(values: Floats, which: Ints, count: int) -> Floats:
    """Values (r, n) summed by number (n,) below count: (count, r)."""
    return np.stack([np.bincount(which, row, count) for row in values], axis=1)
