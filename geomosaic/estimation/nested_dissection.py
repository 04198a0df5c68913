"""Symmetric positive definite systems of frames that meet only their neighbours."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.blas import dsymm, dsyrk, dtrsm
from scipy.sparse import bsr_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, dijkstra

from geomosaic.arrays import Floats, Ints
from geomosaic.constants import tuned
from geomosaic.errors import NotSolvableError
from geomosaic.estimation.linear import cholesky, inverse_of_factor, solve_scaled, square_of_factor

_LEAST_FRAMES = tuned(32, "frames", "that are not cut any further: below, a dense matrix is as fast")
_MIDDLE: tuple[float, float] = tuned((0.3, 0.7), "share of the frames", "to cut at; farther out: small parts")
_MOST_WORK = tuned(0.7, "share of a dense matrix's", "operations; with more, dissection takes longer")
_UNDETERMINED = "the equations do not determine the unknowns of these frames"


@dataclass(frozen=True)
class _Front:
    """Frames that are eliminated together, and those beyond that they, or any eliminated before for them,
    meet. blocks: of the matrix that belong here, with rows and columns as places among own and beyond. parts:
    the fronts that come right before, each with the places of what lies beyond it."""

    own: Ints
    beyond: Ints
    blocks: tuple[Ints, Ints, Ints]
    parts: tuple[tuple[int, Ints], ...]

    @property
    def work(self) -> float:
        """Multiplications of its elimination, in cubes of a frame's unknowns."""
        own, beyond = len(self.own), len(self.beyond)
        return own * (own * own / 3.0 + own * beyond + beyond * beyond)


@dataclass(frozen=True)
class Dissection:
    """In which order frames are eliminated: those that part the others from each other after these, and so on
    within each part (nested dissection; George and Liu 1981, chapter 8)."""

    fronts: tuple[_Front, ...]

    @classmethod
    def of(cls, columns: Ints, starts: Ints) -> Dissection:
        """For a matrix whose blocks have these columns, those of each row from its start on."""
        f = len(starts) - 1
        graph = csr_matrix((np.ones(len(columns)), columns, starts), shape=(f, f))
        owns: list[Ints] = []
        parts: list[list[int]] = []
        _cut(graph, np.arange(f), owns, parts)
        rank = np.empty(f, dtype=np.intp)
        rank[np.concatenate(owns)] = np.arange(f)
        front_of = np.repeat(np.arange(len(owns)), [len(own) for own in owns])[rank]
        row = np.repeat(np.arange(f), np.diff(starts))
        lower = np.flatnonzero(rank[row] >= rank[columns])
        lower = lower[np.argsort(front_of[columns[lower]], kind="stable")]
        ends = np.searchsorted(front_of[columns[lower]], np.arange(len(owns) + 1))
        place = np.empty(f, dtype=np.intp)
        fronts: list[_Front] = []
        for k, own in enumerate(owns):
            mine = lower[ends[k] : ends[k + 1]]
            met = np.unique(np.concatenate([row[mine], *(fronts[part].beyond for part in parts[k])]))
            beyond = met[front_of[met] > k]
            beyond = beyond[np.argsort(rank[beyond])]
            place[own], place[beyond] = np.arange(len(own)), len(own) + np.arange(len(beyond))
            blocks = mine, place[row[mine]], place[columns[mine]]
            fronts.append(_Front(own, beyond, blocks, tuple((p, place[fronts[p].beyond]) for p in parts[k])))
        if len(fronts) > 1 and sum(front.work for front in fronts) > _MOST_WORK * f**3 / 3.0:
            below = np.flatnonzero(row >= columns)
            return cls((_Front(np.arange(f), np.arange(0), (below, row[below], columns[below]), ()),))
        return cls(tuple(fronts))


def matrix_of_pairs(f: int, left: Ints, right: Ints) -> tuple[Ints, Ints, Ints]:
    """Columns and row starts of a matrix of f frames, and the order of its blocks. It has a block for each
    frame and, on both sides of its diagonal, for each pair. The order counts frames first, then pairs, then
    pairs turned over."""
    row = np.concatenate([np.arange(f), left, right])
    column = np.concatenate([np.arange(f), right, left])
    order = np.lexsort((column, row))
    starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=f))])
    return column[order], starts, order


def _cut(graph: csr_matrix, frames: Ints, owns: list[Ints], parts: list[list[int]]) -> list[int]:
    """Adds the fronts of some frames; the last ones of each part that hangs together."""
    last = []
    count, part = connected_components(graph, directed=False)
    order = np.argsort(part, kind="stable")
    for mine in np.split(order, np.cumsum(np.bincount(part, minlength=count))[:-1]):
        within = graph[mine][:, mine] if count > 1 else graph
        between = _between(within) if len(mine) > _LEAST_FRAMES else np.arange(len(mine))
        rest = np.setdiff1d(np.arange(len(mine)), between)
        before = _cut(within[rest][:, rest], frames[mine[rest]], owns, parts) if len(rest) else []
        owns.append(frames[mine[between]])
        parts.append(before)
        last.append(len(owns) - 1)
    return last


def _between(graph: csr_matrix) -> Ints:
    """Frames that part the others, or all of them if none do."""
    far = 0
    for _ in range(2):
        far = int(breadth_first_order(graph, far, directed=False, return_predecessors=False)[-1])
    steps = dijkstra(graph, directed=False, indices=far, unweighted=True).astype(np.intp)
    sizes = np.bincount(steps)
    before = np.cumsum(sizes) - sizes
    least, most = (share * len(steps) for share in _MIDDLE)
    inside = np.flatnonzero((before + sizes >= least) & (before <= most) & (np.arange(len(sizes)) > 0))
    inside = inside[inside < len(sizes) - 1]
    if not len(inside):
        return np.arange(len(steps))
    at = inside[sizes[inside].argmin()]
    behind = graph @ (steps > at).astype(np.float64) > 0.0
    return np.flatnonzero((steps == at) & behind)


class Dissected:
    """Cholesky factors of a sparse matrix of f x f blocks (b, b), both triangles given, front by front
    (multifrontal; Duff and Reid 1983). Inside a front all is dense; only lower triangles are computed, in
    LAPACK's order of columns. Raises: NotSolvableError, naming the frame, if the matrix is not positive
    definite."""

    def __init__(self, matrix: bsr_matrix, dissection: Dissection | None = None) -> None:
        self._fronts = (dissection or Dissection.of(matrix.indices, matrix.indptr)).fronts
        self._block = b = matrix.blocksize[0]
        self._own: list[Floats] = []
        self._below: list[Floats] = []
        left: dict[int, Floats] = {}
        for k, front in enumerate(self._fronts):
            size, frames = b * len(front.own), len(front.own) + len(front.beyond)
            dense = np.zeros((b * frames, b * frames), order="F")
            which, row, column = front.blocks
            by_column = dense.T.reshape(frames, b, frames, b)
            by_column[column, :, row, :] = np.swapaxes(matrix.data, 1, 2)[which]
            for part, place in front.parts:
                update = left.pop(part)
                for here, there in self._lower(place):
                    dense[there] += update[here]
            below = np.asfortranarray(dense[size:, :size])
            beyond = np.asfortranarray(dense[size:, size:])
            own = self._cholesky(
                dense if size == len(dense) else np.asfortranarray(dense[:size, :size]), front
            )
            if len(below):
                below = dtrsm(1.0, own, below, side=1, lower=1, trans_a=1, overwrite_b=1)
                left[k] = dsyrk(-1.0, below, beta=1.0, c=beyond, lower=1, overwrite_c=1)
            self._own.append(own)
            self._below.append(below)

    def _cholesky(self, matrix: Floats, front: _Front) -> Floats:
        factor, broken_at = cholesky(matrix, overwrite=True)
        if broken_at >= 0:
            raise NotSolvableError(_UNDETERMINED, frames=(int(front.own[broken_at // self._block]),))
        return factor

    def _unknowns(self, frames: Ints) -> Ints:
        out: Ints = self._block * frames[:, None] + np.arange(self._block)
        return out.ravel()

    def _lower(self, places: Ints) -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice]]]:
        """Rows and columns of the lower triangle of frames in order, piece by piece, and where each lies
        in a matrix of frames that has them at these rising places."""
        breaks = np.flatnonzero(np.diff(places) != 1) + 1
        bounds = [0, *breaks.tolist(), len(places)] if len(places) else [0]
        here = [slice(self._block * a, self._block * z) for a, z in pairwise(bounds)]
        starts = (self._block * places[bounds[:-1]]).tolist()
        there = [slice(at, at + s.stop - s.start) for at, s in zip(starts, here, strict=True)]
        for i in range(len(here)):
            for j in range(i + 1):
                yield (here[i], here[j]), (there[i], there[j])

    def solve(self, side: Floats) -> Floats:
        """Solutions (f b,) or (f b, r) for right sides of that shape."""
        x = side.copy()
        fronts = list(zip(self._fronts, self._own, self._below, strict=True))
        for front, factor, below in fronts:
            own, beyond = self._unknowns(front.own), self._unknowns(front.beyond)
            x[own] = solve_triangular(factor, x[own], lower=True, check_finite=False)
            x[beyond] -= below @ x[own]
        for front, factor, below in reversed(fronts):
            own, beyond = self._unknowns(front.own), self._unknowns(front.beyond)
            rest = x[own] - below.T @ x[beyond]
            x[own] = solve_triangular(factor, rest, lower=True, trans="T", check_finite=False)
        return x

    def inverse_blocks(self) -> Floats:
        """The inverse's diagonal blocks (f, b, b), by the recursion of Takahashi et al. (1973)."""
        b = self._block
        out = np.empty((sum(len(front.own) for front in self._fronts), b, b))
        beyond: dict[int, Floats] = {}
        for k in reversed(range(len(self._fronts))):
            front, factor, below = self._fronts[k], self._own[k], self._below[k]
            size, turned = len(factor), inverse_of_factor(factor)
            columns = [turned[i:, i : i + b] for i in range(0, size, b)]
            blocks = np.stack([column.T @ column for column in columns])
            carried = meets = below
            if len(below):
                carried = dtrsm(1.0, factor, below, side=1, lower=1)
                meets = dsymm(-1.0, beyond[k], carried, lower=1)
                by_frame = (len(front.own), b, -1)
                blocks -= carried.T.reshape(by_frame) @ np.swapaxes(meets.T.reshape(by_frame), 1, 2)
            out[front.own] = blocks
            parts = [(part, place) for part, place in front.parts if len(place)]
            if parts:
                inverse = np.empty((size + len(below),) * 2, order="F")
                inverse[:size, :size] = square_of_factor(turned)
                if len(below):
                    inverse[:size, :size] -= carried.T @ meets
                    inverse[size:, :size], inverse[size:, size:] = meets, beyond[k]
            for part, place in parts:
                beyond[part] = np.empty((b * len(place),) * 2, order="F")
                for here, there in self._lower(place):
                    beyond[part][here] = inverse[there]
            beyond.pop(k, None)
        return out


@dataclass(frozen=True)
class Bordered:
    """A symmetric positive definite system: f frames' blocks (b, b), bordered by a few unknowns that all of
    them meet: border (f b, s), corner (s, s). order: in which frames are eliminated, where that is known."""

    blocks: bsr_matrix
    border: Floats
    corner: Floats
    order: Dissection | None = None

    @cached_property
    def _factors(self) -> Dissected:
        return Dissected(self.blocks, self.order)

    @cached_property
    def _by_border(self) -> Floats:
        return self._factors.solve(self.border)

    def solve(self, side: Floats) -> Floats:
        """Solutions (f b + s,) or (f b + s, r) for right sides of that shape. Raises: NotSolvableError."""
        n = len(self.border)
        alone = self._factors.solve(side[:n])
        left = side[n:] - self.border.T @ alone
        shared = solve_scaled(self.corner - self.border.T @ self._by_border, left.reshape(len(left), -1))
        shared = shared.reshape(left.shape)
        return np.concatenate([alone - self._by_border @ shared, shared])
