"""Sums over the observations of a group of points: bundle equations and their Schur complement."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.sparse import csc_matrix

from geomosaic.adjustment.kernels.observation_groups import Group
from geomosaic.adjustment.kernels.pose_jacobian import Levers
from geomosaic.arrays import Floats, Ints
from geomosaic.estimation.linear import multiply_each


def scaled_rows(levers: Levers, point_point: Floats, root: Floats, which: Ints) -> Floats:
    """Point by pose blocks of observations, multiplied with the roots of their points' inverses, and a block
    of zeros: (m + 1, 3, d).

    Args: point_point (3, 3, m): what each adds to its point's block; root (p, 3, 3); which (m,): of p points.
    """
    roots = np.ascontiguousarray(np.moveaxis(root, 0, -1)).take(which, axis=-1)
    by_pose = levers.by_pose(multiply_each(roots, point_point))
    out = np.zeros((len(which) + 1, *by_pose.shape[:2]))
    out[:-1] = by_pose.transpose(2, 0, 1)
    return out


def less_of_frames(group: Group, scaled: Floats, seen: Floats, sums: tuple[Floats, Ints, Floats]) -> None:
    """Subtracts the Schur complement's part on the diagonal from each frame's block, and adds the products
    with the points' other columns.

    Args: scaled: of `scaled_rows`; seen (m, 3, r): the other columns, scaled alike; sums: blocks (n, d, d),
        the frames' places in them (f,), and the products (f, d, r).
    """
    blocks, own, others = sums
    rows = scaled.reshape(-1, scaled.shape[-1])
    seen = seen.reshape(-1, seen.shape[-1])
    runs = pairwise((3 * group.runs).tolist())
    for i, at, (here, end) in zip(group.frames.tolist(), own[group.frames].tolist(), runs, strict=True):
        mine = rows[here:end]
        blocks[at] -= mine.T @ mine
        others[i] += mine.T @ seen[here:end]


def less_of_pairs(group: Group, scaled: Floats, blocks: Floats, across: Ints) -> None:
    """Subtracts the Schur complement's part between frames; across (k,): the pairs' places among blocks."""
    m, _, d = scaled.shape
    rows, starts = scaled.reshape(m, -1), group.shared.tolist()
    left, right = np.empty((2, max(np.diff(starts), default=0), 3 * d))
    for (here, end), (begin, stop) in zip(pairwise(group.batches.tolist()), pairwise(starts), strict=True):
        for which, taken in ((group.one, left), (group.other, right)):  # "clip" writes without a buffer
            rows.take(which[begin:stop], axis=0, out=taken[: stop - begin], mode="clip")
        one, other = (taken[: stop - begin].reshape(end - here, -1, d) for taken in (left, right))
        blocks[across[group.pairs[here:end]]] -= np.swapaxes(one, 1, 2) @ other


def summed_by_point(rows: Floats, which: Ints, count: int) -> Floats:
    """Products with derivatives by the point, summed by point: (3 count, n).

    Args: rows (2, n, m): both rows of each observation, derivatives by its point last; which (m,): its point.
    """
    each = np.ascontiguousarray(np.swapaxes(rows, 1, 2)).reshape(2 * len(which), -1)
    place = np.tile((3 * which[:, None] + np.arange(3)).astype(np.int32).ravel(), 2)
    starts = np.arange(0, len(place) + 1, 3, dtype=np.int32)
    by_point = csc_matrix((each[:, -3:].ravel(), place, starts), shape=(3 * count, len(each)))
    return np.asarray(by_point @ each)


def summed_by(values: Floats, which: Ints, count: int) -> Floats:
    """Values (r, n) summed by number (n,) below count: (count, r)."""
    return np.stack([np.bincount(which, row, count) for row in values], axis=1)
