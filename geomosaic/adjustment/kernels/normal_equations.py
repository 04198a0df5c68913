"""Normal equations of a bundle: blocks by frame, camera and point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import csc_matrix

from geomosaic.adjustment.kernels.ahead import ahead
from geomosaic.adjustment.kernels.observation_groups import Group, Sightings
from geomosaic.adjustment.kernels.pose_jacobian import Levers
from geomosaic.arrays import Floats, Ints
from geomosaic.constants import sourced

_LOWER = np.tril_indices(len("xyz"))
Linearised = Callable[[Ints], tuple[Floats, Floats, Levers, Floats, Floats]]
"""See `build_normals`."""
SQUARE: Ints = sourced(
    np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]]), "places", "of (3, 3) in its triangle", "np.tril_indices"
)


@dataclass(frozen=True)
class Normals:
    """Blocks of A'PA and A'Pl. There are f frames of d unknowns (poses first), c cameras of k, p points of 3,
    one shared ground level, and q unknowns of the mounting. The mounting meets the poses alone.

    pose (f, d, d), interior (c, k, k), points (p, 3, 3), mounting (q, q); sides alike. pose_interior (f, d,
    k): each frame with its own camera; pose_mounting (f, d, q); interior_point (c, p, k, 3); level_point (p,
    3): minus weight times the surface's normal. point_point (6, m): what each sighting adds to its point's
    block, its lower triangle row by row; blocks of point by pose follow from that and the sightings' levers.
    """

    sightings: Sightings
    camera_of: Ints
    pose: Floats
    interior: Floats
    points: Floats
    pose_interior: Floats
    point_point: Floats
    levers: Levers
    interior_point: Floats
    pose_side: Floats
    interior_side: Floats
    point_side: Floats
    level_point: Floats
    level: float
    level_side: float
    pose_mounting: Floats
    mounting: Floats
    mounting_side: Floats

    def point_pose(self, sighting: int) -> Floats:
        """Its block, (3, d)."""
        it = slice(sighting, sighting + 1)
        return self.levers.of(it).by_pose(self.point_point[SQUARE, it])[..., 0]


def build_normals(
    sightings: Sightings,
    camera_of: Ints,
    counts: tuple[int, int, int],
    linearised: Linearised,
    terms: int = 0,
) -> Normals:
    """Sums of the image observations, some points at a time, so that no array of all derivatives is made;
    priors are added afterwards. Args: camera_of (f,); counts: cameras, numbers of a camera, unknowns of the
    mounting; terms: rotation terms of each frame, with which it drifts. linearised: of some observations (n,)
    residuals (2, n) observed minus computed, weights (n,), levers, derivatives by interior (2, k, n) and by
    point (2, 3, n), see `project_by_levers`."""
    (c, k, q), f, p, m = counts, sightings.frames, sightings.points, len(sightings.order)
    axes = np.empty((3, 3, m if terms else 0))
    levers = Levers(np.empty((3, m)), np.empty((terms, m)), np.empty((min(terms, 1), m)), axes)
    point_point, d = np.empty((6, m)), levers.numbers
    in_frame = np.zeros((f, d + k + 1, d + k + 1))
    interior_point, points, point_side = np.empty((c, p, k, 3)), np.empty((p, 3, 3)), np.empty((p, 3))

    def weighted_rows(group: Group) -> Floats:
        residual, weight, its, by_interior, by_point = linearised(sightings.order[group.span].astype(np.intp))
        for name in ("arms_m", "terms", "shares", "axes"):
            getattr(levers, name)[..., group.span] = getattr(its, name)
        rows, root = np.empty((2, d + k + 4, len(weight))), np.sqrt(weight)
        np.multiply(by_point, root, out=rows[:, -3:])
        np.multiply(by_interior, root, out=rows[:, d:-4])
        np.multiply(residual, root, out=rows[:, -4])
        its.by_pose(rows[:, -3:], out=rows[:, :d])
        return rows

    for group, rows in ahead(weighted_rows, sightings.groups):
        for i, (here, end) in zip(group.frames, pairwise(group.runs), strict=True):
            across, down = rows[:, :-3, here:end]
            in_frame[i] += across @ across.T + down @ down.T
        for i, j, row in zip(*_LOWER, point_point[:, group.span], strict=True):
            np.multiply(rows[0, i - 3], rows[0, j - 3], out=row)
            row += rows[1, i - 3] * rows[1, j - 3]
        which = sightings.point[group.span] - group.points.start
        which = which + group.size * camera_of[sightings.frame[group.span]]
        summed = _summed_by_point(rows[:, d:], which, c * group.size).reshape(c, group.size, 3, k + 4)
        interior_point[:, group.points] = np.swapaxes(summed[..., :k], 2, 3)
        point_side[group.points] = summed[..., k].sum(axis=0)
        points[group.points] = summed[..., k + 1 :].sum(axis=0)
    of_camera = np.eye(c)[camera_of].T
    return Normals(
        sightings=sightings,
        camera_of=camera_of,
        pose=in_frame[:, :d, :d].copy(),
        interior=np.tensordot(of_camera, in_frame[:, d:-1, d:-1], axes=1),
        points=points,
        pose_interior=in_frame[:, :d, d:-1],
        point_point=point_point,
        levers=levers,
        interior_point=interior_point,
        pose_side=in_frame[:, :d, -1].copy(),
        interior_side=of_camera @ in_frame[:, d:-1, -1],
        point_side=point_side,
        level_point=np.zeros((p, 3)),
        level=0.0,
        level_side=0.0,
        pose_mounting=np.zeros((f, d, q)),
        mounting=np.zeros((q, q)),
        mounting_side=np.zeros(q),
    )


def _summed_by_point(rows: Floats, which: Ints, count: int) -> Floats:
    """Products with derivatives by the point, summed by point, (3 count, n). Args: rows (2, n, m): both rows
    of each observation, derivatives by its point last; which (m,): its point."""
    each = np.ascontiguousarray(np.swapaxes(rows, 1, 2)).reshape(2 * len(which), -1)
    place = np.tile((3 * which[:, None] + np.arange(3)).astype(np.int32).ravel(), 2)
    starts = np.arange(0, len(place) + 1, 3, dtype=np.int32)
    by_point = csc_matrix((each[:, -3:].ravel(), place, starts), shape=(3 * count, len(each)))
    return np.asarray(by_point @ each)
