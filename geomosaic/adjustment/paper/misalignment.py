"""Misalignments of pairs of frames on the ground: the paper's histogram, and the net of all pairs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from geomosaic.adjustment.model import Block
from geomosaic.arrays import Floats, Ints
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.matching.model import TiePairs
from geomosaic.projection.footprint import ground_from_images
from geomosaic.projection.ground import GroundSurface


def fullest_bin_mean(differences: Floats, step: float = 1.0) -> Floats:
    """Misalignment (2,) of a pair: the mean of the fullest histogram bin, each axis by itself, of equally
    full ones the nearest to the median (Yue et al. 2021, equation 5). Args: differences (k, 2), k >= 1, of
    tie points, in the unit of `step`, the width of a bin."""
    return fullest_bin_means(differences, np.zeros(len(differences), np.intp), step).ravel()


def fullest_bin_means(differences: Floats, pair: Ints, step: float) -> Floats:
    """The same of many pairs at once, (m, 2). pair (k,): from 0 to m - 1, each at least once."""
    out = np.empty((int(pair.max()) + 1, 2))
    middle, row = np.bincount(pair) / 2.0, np.cumsum(np.bincount(pair))
    first, last = row - np.ceil(middle + 0.5).astype(int), row - np.floor(middle + 0.5).astype(int)
    for axis, values in enumerate(differences.T):
        by_value = np.lexsort((values, pair))
        its, ordered = pair[by_value], values[by_value]
        median = (ordered[first] + ordered[last]) / 2.0
        name = np.floor(ordered / step)
        begins = np.flatnonzero((np.diff(name, prepend=np.nan) != 0.0) | (np.diff(its, prepend=-1) > 0))
        counts = np.diff(begins, append=len(ordered))
        of, away = its[begins], np.abs(name[begins] + 0.5 - median[its[begins]] / step)
        best = np.lexsort((away, -counts, of))
        chosen = best[np.diff(of[best], prepend=-1) > 0]
        out[:, axis] = np.add.reduceat(ordered, begins)[chosen] / counts[chosen]
    return out


@dataclass(frozen=True)
class OffsetNet:
    """A block as n frames that shift over the map. pairs: (m, 2) frame indices, the lower first. left_m,
    right_m: per pair (k, 2) east and north of the tie points by either frame before any move. step_m: width
    of the histogram's bins."""

    n: int
    pairs: Ints
    left_m: tuple[Floats, ...]
    right_m: tuple[Floats, ...]
    step_m: float

    def differences_m(self, pair: int, moves_m: Floats) -> Floats:
        """Right minus left (k, 2) of one pair after the frames' moves_m (n, 2)."""
        a, b = self.pairs[pair]
        return np.asarray(self.right_m[pair] - self.left_m[pair] + (moves_m[b] - moves_m[a]))

    def misalignment_m(self, pair: int, moves_m: Floats, seen_from: int | None = None) -> Floats:
        """Misalignment (2,) of one pair: right minus left, or the other frame minus `seen_from`."""
        m = fullest_bin_mean(self.differences_m(pair, moves_m), self.step_m)
        return m if seen_from in (None, self.pairs[pair][0]) else -m

    def misalignments_m(self, moves_m: Floats) -> Floats:
        """Misalignment of every pair, (m, 2)."""
        if not len(self.pairs):
            return np.zeros((0, 2))
        every = range(len(self.pairs))
        pair = np.repeat(every, [len(left) for left in self.left_m])
        return fullest_bin_means(
            np.concatenate([self.differences_m(p, moves_m) for p in every]), pair, self.step_m
        )

    @cached_property
    def edges(self) -> list[tuple[int, int]]:
        """The pairs as plain tuples."""
        return [(int(a), int(b)) for a, b in self.pairs]

    @cached_property
    def pair_of(self) -> dict[tuple[int, int], int]:
        """The number of the pair of two frames, in either order."""
        return {pair: p for p, (a, b) in enumerate(self.edges) for pair in ((a, b), (b, a))}


def ties_on_ground(
    block: Block, poses: Poses, cameras: Sequence[Camera], ground: GroundSurface
) -> Iterator[tuple[Floats, Floats]]:
    """East and north (k, 2) of each pair's tie points by its left and its right frame, NaN where missing."""
    ties = TiePairs.of(block.ties.pairs)
    plan_m = ground_from_images(ties.frame.astype(np.intp), ties.image_px, poses, cameras, ground)[:, :2]
    plan_m = plan_m.copy()
    for left, right in ties.ends:
        yield plan_m[left], plan_m[right]


def offset_net(block: Block) -> OffsetNet:
    """The net of a block's tie points on the ground; points that miss it are left out."""
    left, right, pairs = [], [], []
    on_ground = ties_on_ground(block, block.poses, block.cameras, block.ground)
    for pair, (a, b) in zip(block.ties.frames, on_ground, strict=True):
        hit = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
        if hit.any():
            pairs.append(pair)
            left.append(a[hit])
            right.append(b[hit])
    both = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    return OffsetNet(len(block.names), both, tuple(left), tuple(right), block.ground_pixel_m)
