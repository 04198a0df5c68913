"""Symmetric positive definite systems of frames that meet only their neighbours."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf
from scipy.sparse import bsr_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components

from geomosaic.constants import CHOSEN, Because
from geomosaic.errors import NotSolvableError

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_LEAST_FRAMES: Annotated[
    int,
    Because(
        "frames",
        "below which a dense matrix is as fast",
        CHOSEN,
    ),
] = 16
_UNDETERMINED = "the block does not determine the poses of its frames"


class BlockTridiagonal:
    """Cholesky factors of a sparse matrix of f x f blocks (b, b), both triangles given.

    Frames are put in order of their distance, in ties, from one at the block's rim, and cut into groups
    that meet only the group before and the one after (George and Liu 1981, chapter 4): lines of 50 frames
    give groups of about as many. Inside groups all is dense, and a block whose frames all meet is one group.

    Raises: NotSolvableError, which names the frame where it shows, if the matrix is not positive definite.
    """

    def __init__(self, matrix: bsr_matrix) -> None:
        b = matrix.blocksize[0]
        f = matrix.shape[0] // b
        graph = csr_matrix((np.ones(len(matrix.indices)), matrix.indices, matrix.indptr), shape=(f, f))
        self._order = _from_the_rim(graph)
        self._unknowns = (b * self._order[:, None] + np.arange(b)).ravel()
        self._block = b
        rank = np.empty(f, dtype=np.intp)
        rank[self._order] = np.arange(f)
        row, column = np.repeat(rank, np.diff(matrix.indptr)), rank[matrix.indices]
        ends = _groups(row, column, f)
        group = np.repeat(np.arange(len(ends) - 1), np.diff(ends))
        self._spans = [slice(b * i, b * j) for i, j in pairwise(ends)]
        self._diagonal: list[Floats] = []
        self._below: list[Floats] = []
        before = slice(0, 0)
        for k, span in enumerate(self._spans):
            mine = np.flatnonzero(group[row] == k)
            own, back = mine[group[column[mine]] == k], mine[group[column[mine]] == k - 1]
            diagonal = _dense(matrix.data[own], row[own] - ends[k], column[own] - ends[k], span, span)
            start = ends[k - 1] if k else 0
            below = _dense(matrix.data[back], row[back] - ends[k], column[back] - start, span, before)
            if k:
                last = self._diagonal[-1]
                below = solve_triangular(last, below.T, lower=True, overwrite_b=True, check_finite=False).T
                diagonal -= below @ below.T
            self._below.append(below)
            self._diagonal.append(self._cholesky(diagonal, span))
            before = span

    def _cholesky(self, matrix: Floats, span: slice) -> Floats:
        factor, broken = dpotrf(matrix, lower=1, clean=1, overwrite_a=1)
        good = np.diag(factor) > 0.0
        if broken or not good.all():
            first = broken - 1 if broken else int(good.argmin())
            weak = int(self._order[(span.start + first) // self._block])
            raise NotSolvableError(_UNDETERMINED, frames=(weak,))
        return np.asarray(factor)

    def solve(self, side: Floats) -> Floats:
        """Solutions (f b, r) for right sides (f b, r)."""
        x: Floats = side[self._unknowns]
        before = slice(0, 0)
        for factor, below, span in zip(self._diagonal, self._below, self._spans, strict=True):
            x[span] = solve_triangular(factor, x[span] - below @ x[before], lower=True, check_finite=False)
            before = span
        after = slice(0, 0)
        for factor, below, span in self._backwards():
            rest = x[span] - below.T @ x[after]
            x[span] = solve_triangular(factor, rest, lower=True, trans="T", check_finite=False)
            after = span
        out = np.empty_like(x)
        out[self._unknowns] = x
        return out

    def inverse_blocks(self) -> Floats:
        """The inverse's diagonal blocks (f, b, b), by the recursion of Takahashi et al. (1973)."""
        b = self._block
        out = np.empty((len(self._order), b, b))
        inverse = np.zeros((0, 0))
        for factor, below, span in self._backwards():
            turned = solve_triangular(factor, np.eye(len(factor)), lower=True, check_finite=False)
            carried = below @ turned
            inverse = turned.T @ turned + carried.T @ (inverse @ carried)
            frames = np.arange(len(factor) // b)
            blocks = inverse.reshape(len(frames), b, len(frames), b)
            out[self._order[span.start // b : span.stop // b]] = blocks[frames, :, frames, :]
        return out

    def _backwards(self) -> Iterator[tuple[Floats, Floats, slice]]:
        """Groups from the last to the first: factor, the next group's block below it, place."""
        below = [*self._below[1:], np.zeros((0, len(self._diagonal[-1])))]
        return zip(reversed(self._diagonal), reversed(below), reversed(self._spans), strict=True)


def _from_the_rim(graph: csr_matrix) -> Ints:
    """Frames in order of their distance from one that is far from the others, part by part."""
    _, part = connected_components(graph, directed=False)
    order = []
    for first in np.unique(part, return_index=True)[1]:
        far = first
        for _ in range(2):
            far = breadth_first_order(graph, far, directed=False, return_predecessors=False)[-1]
        order.append(breadth_first_order(graph, far, directed=False, return_predecessors=False))
    return np.concatenate(order).astype(np.intp)


def _groups(row: Ints, column: Ints, frames: int) -> list[int]:
    """Where groups begin, and the end: each reaches as far as what the one before it meets."""
    reach = np.arange(frames)
    np.maximum.at(reach, row, column)
    reach = np.maximum.accumulate(reach)
    ends = [0]
    end = min(_LEAST_FRAMES, frames)
    while end < frames:
        ends.append(end)
        end = min(max(int(reach[end - 1]) + 1, end + _LEAST_FRAMES), frames)
    return [*ends, frames]


def _dense(blocks: Floats, row: Ints, column: Ints, rows: slice, columns: slice) -> Floats:
    b = blocks.shape[-1]
    out = np.zeros((rows.stop - rows.start, columns.stop - columns.start))
    out.reshape(out.shape[0] // b, b, out.shape[1] // b, b)[row, :, column, :] = blocks
    return out
