"""Misalignments of pairs of frames on the ground: the paper's histogram, and the net of all pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from geomosaic.adjustment.model import Block
from geomosaic.arrays import Bools, Floats, Ints, Ints32
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import TOGETHER
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
    """A block as n frames that shift over the map. pairs: (m, 2) frame indices, the lower first. plan_m: east
    and north of all keypoints (k, 2) before any move; ends: of each pair those of its tie points, by the left
    and the right frame (2, t). step_m: width of the histogram's bins."""

    n: int
    pairs: Ints
    plan_m: Floats
    ends: tuple[Ints32, ...]
    step_m: float

    def both_m(self, pair: int) -> tuple[Floats, Floats]:
        """East and north (t, 2) of one pair's tie points by the left and the right frame."""
        left, right = self.ends[pair]
        return self.plan_m[left], self.plan_m[right]

    def differences_m(self, pair: int, moves_m: Floats) -> Floats:
        """Right minus left (t, 2) of one pair after the frames' moves_m (n, 2)."""
        (a, b), (left, right) = self.pairs[pair], self.both_m(pair)
        return np.asarray(right - left + (moves_m[b] - moves_m[a]))

    def misalignment_m(self, pair: int, moves_m: Floats, seen_from: int | None = None) -> Floats:
        """Misalignment (2,) of one pair: right minus left, or the other frame minus `seen_from`."""
        m = fullest_bin_mean(self.differences_m(pair, moves_m), self.step_m)
        return m if seen_from in (None, self.pairs[pair][0]) else -m

    def misalignments_m(self, moves_m: Floats) -> Floats:
        """Misalignment of every pair, (m, 2)."""
        out = np.empty((len(self.pairs), 2))
        for first in range(0, len(out), TOGETHER):
            some = range(first, min(first + TOGETHER, len(out)))
            differences_m = [self.differences_m(p, moves_m) for p in some]
            pair = np.repeat(np.arange(len(some)), [len(d) for d in differences_m])
            out[some] = fullest_bin_means(np.concatenate(differences_m), pair, self.step_m)
        return out

    @cached_property
    def edges(self) -> list[tuple[int, int]]:
        """The pairs as plain tuples."""
        return [(int(a), int(b)) for a, b in self.pairs]

    @cached_property
    def pair_of(self) -> dict[tuple[int, int], int]:
        """The number of the pair of two frames, in either order."""
        return {pair: p for p, (a, b) in enumerate(self.edges) for pair in ((a, b), (b, a))}


def keypoints_on_ground(
    block: Block, poses: Poses, cameras: Sequence[Camera], ground: GroundSurface
) -> tuple[Floats, tuple[Ints32, ...]]:
    """East and north (k, 2) of the tied keypoints, NaN where their rays miss; of each pair its own (2, t)."""
    ties = TiePairs.of(block.ties.pairs)
    at_m = ground_from_images(ties.frame.astype(np.intp), ties.image_px, poses, cameras, ground)
    return at_m[:, :2].copy(), ties.ends


def offset_net(block: Block) -> OffsetNet:
    """The net of a block's tie points on the ground; points that miss it are left out."""
    plan_m, all_ends = keypoints_on_ground(block, block.poses, block.cameras, block.ground)
    hit: Bools = np.asarray(np.isfinite(plan_m).all(axis=1))
    ends = all_ends if hit.all() else tuple(its[:, hit[its[0]] & hit[its[1]]] for its in all_ends)
    seen = [k for k, its in enumerate(ends) if its.size]
    pairs = np.array(block.ties.frames, dtype=np.intp).reshape(-1, 2)[np.array(seen, dtype=np.intp)]
    return OffsetNet(len(block.names), pairs, plan_m, tuple(ends[k] for k in seen), block.ground_pixel_m)
