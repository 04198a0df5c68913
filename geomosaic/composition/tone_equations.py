"""By which unknowns sightings show how bright a frame is, and the normal equations of these."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix, eye

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.estimation.nested_dissection import Bordered, Dissection

OF_A_FRAME = len(("gain", "slope to the right", "slope below"))
"""Unknowns of a frame."""


@dataclass(frozen=True)
class ToneDesign:
    """Derivatives of m sightings' logarithms by the unknowns (u,): `OF_A_FRAME` of each of n frames, frame by
    frame, then s that frames share. frame (m,) and place (m,) of each sighting; own (m, OF_A_FRAME) by those
    of its frame; shared (m, s). The brightness of each of p places is eliminated."""

    frame: Ints
    place: Ints
    own: Floats
    shared: Floats
    frames: int
    places: int

    @property
    def unknowns(self) -> int:
        """How many there are, u."""
        return OF_A_FRAME * self.frames + len(self.shared.T)

    def of(self, mine: Bools) -> ToneDesign:
        """Of some of the sightings."""
        frame, place, own, shared = self.frame[mine], self.place[mine], self.own[mine], self.shared[mine]
        return ToneDesign(frame, place, own, shared, self.frames, self.places)

    def of_gains(self, rows: csr_matrix) -> csr_matrix:
        """Rows (k, u) of combinations (k, n + c) of the frames' gains and of the first c that they share."""
        gains = OF_A_FRAME * np.arange(self.frames)
        shared = np.arange(OF_A_FRAME * self.frames, self.unknowns)
        at = np.concatenate([gains, shared])[rows.indices]
        return csr_matrix((rows.data, at, rows.indptr), shape=(rows.shape[0], self.unknowns))

    def logs(self, unknowns: Floats) -> Floats:
        """What unknowns (u,) add to the sightings' logarithms (m,)."""
        by_frame = unknowns[: OF_A_FRAME * self.frames].reshape(self.frames, OF_A_FRAME)
        its = (self.own * by_frame[self.frame]).sum(axis=1)
        return np.asarray(its + self.shared @ unknowns[OF_A_FRAME * self.frames :])

    def summed(self, values: Floats) -> Floats:
        """The transposed derivatives times values (m,), for the unknowns (u,)."""
        by_frame = self._of_frame @ (self.own * values[:, None])
        return np.concatenate([by_frame.ravel(), self.shared.T @ values])

    def means(self, weight: Floats, values: Floats) -> Floats:
        """The weighted mean of values (m,) or (m, b) over each sighting's place, of their shape."""
        columns = values if values.ndim > 1 else values[:, None]
        sums = self._of_place @ (columns * weight[:, None]) / self._total(weight)[:, None]
        return np.asarray(sums[self.place].reshape(values.shape))

    def normal(self, weight: Floats, priors: csr_matrix) -> Bordered:
        """Normal equations of sightings' weights (m,) and of priors (u, u), by which frames do not meet."""
        n = OF_A_FRAME * self.frames
        root = 1.0 / np.sqrt(self._total(weight))
        weighed = self.own * weight[:, None]
        rows, columns = np.triu_indices(OF_A_FRAME)
        blocks = np.empty((self.frames, OF_A_FRAME, OF_A_FRAME))
        blocks[:, rows, columns] = self._of_frame @ (weighed[:, rows] * self.own[:, columns])
        blocks[:, columns, rows] = blocks[:, rows, columns]
        by_place = self._of_place
        scaled = (weighed * root[self.place][:, None])[by_place.indices, None]
        met = bsr_matrix((scaled, self.frame[by_place.indices], by_place.indptr), shape=(self.places, n))
        its = np.arange(self.frames + 1)
        alone = bsr_matrix((blocks, its[:-1], its), shape=(n, n)) + priors[:n, :n].tobsr((OF_A_FRAME,) * 2)
        turned = met.T
        by_frame = bsr_matrix(alone - turned @ met)
        by_frame.sort_indices()
        shared = self.shared * weight[:, None]
        of_place = (by_place @ shared) * root[:, None]
        border = np.stack([self.summed(column)[:n] for column in shared.T], axis=1) - turned @ of_place
        corner = self.shared.T @ shared - of_place.T @ of_place
        known = self._dissection if len(by_frame.indices) == len(self._pattern.indices) else None
        return Bordered(by_frame, border + priors[:n, n:].toarray(), corner + priors[n:, n:].toarray(), known)

    def _total(self, weight: Floats) -> Floats:
        """The sum (p,) of weights (m,) over each place, above zero."""
        return np.maximum(np.bincount(self.place, weight, self.places), np.finfo(np.float64).tiny)

    @cached_property
    def _pattern(self) -> csr_matrix:
        """Which frames meet at a place, (n, n)."""
        meets = self._of_place @ self._of_frame.T
        pattern = csr_matrix(meets.T @ meets + eye(self.frames))
        pattern.sort_indices()
        return pattern

    @cached_property
    def _dissection(self) -> Dissection:
        return Dissection.of(self._pattern.indices, self._pattern.indptr)

    @cached_property
    def _of_frame(self) -> csr_matrix:
        return _sums(self.frame, self.frames)

    @cached_property
    def _of_place(self) -> csr_matrix:
        return _sums(self.place, self.places)


def _sums(group: Ints, count: int) -> csr_matrix:
    """A matrix (count, m) that sums m rows by their group."""
    starts = np.concatenate([[0], np.cumsum(np.bincount(group, minlength=count))])
    order = np.argsort(group, kind="stable")
    return csr_matrix((np.ones(len(group)), order, starts), shape=(count, len(group)))
